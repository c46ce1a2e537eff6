//! The two files that hold a secret: a node's key, and the robot's.
//!
//! ```text
//! blastema node key 1            blastema robot key 1
//! robot   ranger                 robot   ranger
//! node    base                   seed    h2vX…
//! seed    h2vX…                  (the signed roster)
//! signer  9fJq…
//! ```

use super::crypto::{PublicKey, Seed};
use super::roster::{NodeRoster, ROSTER_BYTES};
use super::text::{Lines, TrustError, TrustProblem, decode, encode, public_key};
use crate::NodeName;
use zeroize::Zeroizing;

/// The longest file of a node's key, in bytes.
pub const KEY_FILE_BYTES: usize = 4 * 1024;
/// The lines of a robot's file before its roster.
const ROBOT_LINES: usize = 3;
const NODE_TITLE: &str = "blastema node key 1";
const ROBOT_TITLE: &str = "blastema robot key 1";

/// The file of a node's key. Its robot has a name like a node's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeyFile {
    /// The robot that the node belongs to.
    pub robot: NodeName,
    /// The node that the key belongs to.
    pub node: NodeName,
    /// The node's secret.
    pub seed: Seed,
    /// The public key by which the robot's rosters are checked.
    pub signer: PublicKey,
}

impl KeyFile {
    /// Parses the text of a file.
    ///
    /// # Errors
    /// The line that is wrong, and what to write. No error repeats a word of the text.
    pub fn parse(text: &str) -> Result<Self, TrustError> {
        let mut lines = Lines::new(text, KEY_FILE_BYTES)?;
        lines.title(NODE_TITLE)?;
        let (_, robot) = name(&mut lines, "robot")?;
        let (_, node) = name(&mut lines, "node")?;
        let seed = seed(&mut lines)?;
        let (line, signer) = lines.value("signer")?;
        let signer = public_key(signer).map_err(|problem| problem.at(line))?;
        lines.finish()?;
        Ok(KeyFile { robot, node, seed, signer })
    }

    /// The text of the file.
    pub fn to_text(&self) -> Zeroizing<String> {
        let KeyFile { robot, node, seed, signer } = self;
        let seed = Zeroizing::new(encode(seed.bytes()));
        let head = format!("{NODE_TITLE}\nrobot   {robot}\nnode    {node}\nseed    ");
        whole([&head, &seed, &format!("\nsigner  {signer}\n")])
    }
}

/// The file of a robot's key, with the newest roster. It belongs on no robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RobotFile {
    /// The robot's secret, which signs rosters.
    pub seed: Seed,
    /// The newest roster.
    pub roster: NodeRoster,
}

impl RobotFile {
    /// Parses the text of a file, and checks its roster's signature.
    ///
    /// # Errors
    /// The line that is wrong, and what to write.
    pub fn parse(text: &str) -> Result<Self, TrustError> {
        let mut lines = Lines::new(text, KEY_FILE_BYTES + ROSTER_BYTES)?;
        lines.title(ROBOT_TITLE)?;
        let (at, robot) = name(&mut lines, "robot")?;
        let seed = seed(&mut lines)?;
        let head: usize = text.split_inclusive('\n').take(ROBOT_LINES).map(str::len).sum();
        let roster = NodeRoster::parse_signed(&text[head..], &seed.signer());
        let roster = roster.map_err(|error| error.problem.at(error.line + ROBOT_LINES))?;
        if roster.robot != robot {
            return Err(TrustProblem::expected("the robot's name as the roster has it").at(at));
        }
        Ok(RobotFile { seed, roster })
    }

    /// The text of the file.
    pub fn to_text(&self) -> Zeroizing<String> {
        let seed = Zeroizing::new(encode(self.seed.bytes()));
        let head = format!("{ROBOT_TITLE}\nrobot   {}\nseed    ", self.roster.robot);
        whole([&head, &seed, "\n", &self.roster.sign(&self.seed)])
    }
}

/// In one allocation, so that no copy of a secret is left behind in a buffer that grew.
fn whole<const N: usize>(parts: [&str; N]) -> Zeroizing<String> {
    let mut text = Zeroizing::new(String::with_capacity(parts.iter().map(|part| part.len()).sum()));
    parts.into_iter().for_each(|part| text.push_str(part));
    text
}

/// Reads a name, and where it stands.
fn name(lines: &mut Lines<'_>, word: &str) -> Result<(usize, NodeName), TrustError> {
    let (line, text) = lines.value(word)?;
    // The reason would repeat the word.
    let wrong = |_| TrustProblem::expected("the name of a robot or node").at(line);
    Ok((line, NodeName::new(text).map_err(wrong)?))
}

fn seed(lines: &mut Lines<'_>) -> Result<Seed, TrustError> {
    let (line, letters) = lines.value("seed")?;
    let bytes = decode(letters).ok_or_else(|| TrustProblem::NotKey.at(line))?;
    Ok(Seed::new(bytes))
}
