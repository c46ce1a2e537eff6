//! The list of nodes in an editor: roles and the policy may change.

use super::files::{Existing, SECRET, write};
use blastema::core::net::trust::roster::NodeRoster;
use blastema::keys::read_public;
use std::env;
use std::path::Path;
use std::process::Command;

/// The list with the changes that a user has made to its text, which stands in the file `own` while
/// an editor has it.
pub(super) fn edited(
    roster: &NodeRoster,
    own: &Path,
    from: Option<&Path>,
) -> Result<NodeRoster, String> {
    let path = match from {
        Some(path) => path,
        None if own.exists() => {
            let path = own.display();
            return Err(format!(
                "{path} is there from an edit before: run `blastema keys edit --from {path}`, or \
                 remove it"
            ));
        }
        None => {
            write(own, &roster.to_text(), SECRET, Existing::Keep)?;
            run_editor(own)?;
            own
        }
    };
    let text = read_public(path)?;
    let checked = NodeRoster::parse(&text).map_err(|error| error.to_string());
    checked.and_then(|edited| check(roster, edited)).map_err(|reason| {
        let path = path.display();
        format!("{path}: {reason}; correct it, and run `blastema keys edit --from {path}`")
    })
}

fn run_editor(path: &Path) -> Result<(), String> {
    let named = |name| env::var(name).ok().filter(|editor| !editor.is_empty());
    let editor = named("VISUAL").or_else(|| named("EDITOR")).unwrap_or("vi".to_owned());
    // The variable may hold options as well.
    let status =
        Command::new("sh").args(["-c", &format!("{editor} \"$1\""), "sh"]).arg(path).status();
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{editor} has ended with {status}: remove {}", path.display())),
        Err(error) => Err(format!("{editor} cannot be started: {error}")),
    }
}

/// Only roles and lines of the policy differ.
fn check(before: &NodeRoster, after: NodeRoster) -> Result<NodeRoster, String> {
    let same_head = before.robot == after.robot && before.serial == after.serial;
    let keys = |roster: &NodeRoster| -> Vec<_> {
        roster.nodes().iter().map(|node| (node.name.clone(), node.keys)).collect()
    };
    if same_head && keys(before) == keys(&after) {
        return Ok(after);
    }
    Err("the name of the robot, the serial number, and names and keys of nodes stay as they are; \
         use `blastema keys add`, `revoke` and `replace`"
        .to_owned())
}
