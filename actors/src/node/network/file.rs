//! Networks, their neighbours and the keys from a file, and what overrides it.
//!
//! ```toml
//! keys = "module1.key"
//!
//! [networks.ethernet]
//! endpoint = "udp://10.0.0.1:7400"
//!
//! [networks.ethernet.peers]
//! module2 = "10.0.0.2:7400"
//! module3 = { address = "10.0.0.3:7400", cost = 20, hello_every = "20ms" }
//! ```
//!
//! The table is put together first, from the file and the overrides, and then read as one.

use super::{Link, LinkSettings, Network, NetworkSettings, Remote};
use crate::net::keys::KeysPermissions;
use crate::node::error::StartError;
use serde::de::value::MapAccessDeserializer;
use serde::de::{self, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{env, fmt, fs};
use toml::{Table, Value};

/// Names the file where the program names none.
const FILE_VARIABLE: &str = "BLASTEMA_NETWORKS";
/// Overrides keys of the file: `KEY=VALUE`, several with `;` between them.
const SET_VARIABLE: &str = "BLASTEMA_SET";

/// The file, and what overrides it.
#[derive(Default)]
pub(in crate::node) struct NetworkFile {
    pub(in crate::node) path: Option<PathBuf>,
    /// `KEY=VALUE`, as the program was told.
    pub(in crate::node) overrides: Vec<String>,
}

/// What the file and its overrides describe.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DescribedNetworks {
    /// The file of the node's key.
    pub(super) keys: Option<PathBuf>,
    /// Whether the permissions of that file, its folder and the roster are checked.
    pub(super) keys_permissions: Option<KeysPermissions>,
    /// Nodes whose absence is no fault.
    #[serde(default)]
    pub(super) may_be_away: Vec<String>,
    #[serde(default)]
    networks: BTreeMap<String, NetworkSettings>,
}

impl NetworkFile {
    /// Reads the file and the overrides; `None` if there is neither.
    ///
    /// # Errors
    /// What is wrong, where, and what to write.
    pub(super) fn read(&self) -> Result<Option<DescribedNetworks>, StartError> {
        let path = self.path.clone().or_else(|| {
            env::var_os(FILE_VARIABLE).filter(|path| !path.is_empty()).map(PathBuf::from)
        });
        let set = env::var_os(SET_VARIABLE).map(|set| set.to_string_lossy().into_owned());
        let set = set.iter().flat_map(|set| set.split(';').map(|one| (SET_VARIABLE, one.trim())));
        let set = set.filter(|(_, one)| !one.is_empty());
        let given = self.overrides.iter().map(|one| ("`set`", one.as_str()));
        let overrides: Vec<_> = set.chain(given).collect();
        if path.is_none() && overrides.is_empty() {
            return Ok(None);
        }
        described(path.as_deref(), &overrides)
            .map(Some)
            .map_err(|reason| StartError::NetworkFile { file: path, reason })
    }
}

fn described(path: Option<&Path>, overrides: &[(&str, &str)]) -> Result<DescribedNetworks, String> {
    let mut table = Table::new();
    if let Some(path) = path {
        // A pipe would keep the start for ever.
        let about = fs::metadata(path).map_err(|error| error.to_string())?;
        if !about.is_file() {
            return Err("it is no regular file".to_owned());
        }
        let text = fs::read_to_string(path).map_err(|error| error.to_string())?;
        // Read by itself first: its errors show line and column.
        let read = |error: toml::de::Error| error.to_string().trim_end().to_owned();
        toml::from_str::<DescribedNetworks>(&text).map_err(read)?;
        table = toml::from_str(&text).map_err(read)?;
    }
    for (source, one) in overrides {
        set(&mut table, one).map_err(|why| format!("{source}: {one}: {why}"))?;
    }
    let mut described = DescribedNetworks::deserialize(table).map_err(|error| {
        let set: Vec<_> = overrides.iter().map(|(_, one)| *one).collect();
        format!("with {}: {}", set.join("; "), error.to_string().trim_end())
    })?;
    // What stands in a file is found from where the file is.
    if let (Some(keys), Some(folder)) = (&mut described.keys, path.and_then(Path::parent)) {
        *keys = folder.join(&*keys);
    }
    Ok(described)
}

/// Sets one key of the table: `networks.ethernet.endpoint=udp://…`.
fn set(table: &mut Table, one: &str) -> Result<(), &'static str> {
    let form = "write KEY=VALUE, such as networks.ethernet.endpoint=udp://10.0.0.1:7400";
    let (key, value) = one.split_once('=').ok_or(form)?;
    let (key, value) = (key.trim(), value.trim());
    let value = match toml::from_str::<Table>(&format!("value = {value}")) {
        Ok(mut read) => read.remove("value").ok_or(form)?,
        // A text that needs no quotes here.
        Err(_) => Value::String(value.to_owned()),
    };
    let mut parts: Vec<_> = key.split('.').collect();
    let last = parts.pop().filter(|_| !key.split('.').any(str::is_empty)).ok_or(form)?;
    let mut place = table;
    for part in parts {
        let inner = place.entry(part).or_insert_with(|| Table::new().into());
        place = inner.as_table_mut().ok_or("the key before the last dot is no table")?;
    }
    place.insert(last.to_owned(), value);
    Ok(())
}

impl DescribedNetworks {
    /// The networks, in the order of their names.
    pub(super) fn into_networks(self) -> impl Iterator<Item = Network> {
        self.networks.into_iter().map(|(name, described)| Network::described(&name, described))
    }
}

/// A number and its unit, such as `20ms`, or `never`.
pub(super) fn span<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Duration>, D::Error> {
    let text = String::deserialize(from)?;
    duration(&text).map(Some).ok_or_else(|| {
        de::Error::custom(format!(
            "`{text}` is no time: write a number and its unit (us, ms, s, min, h), such as 20ms, or never"
        ))
    })
}

fn duration(text: &str) -> Option<Duration> {
    if text == "never" {
        return Some(Duration::MAX);
    }
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.')?;
    let (number, unit) = text.split_at(digits);
    let seconds = match unit.trim() {
        "us" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        _ => return None,
    };
    let number: f64 = number.parse().ok()?;
    Duration::try_from_secs_f64(number * seconds).ok()
}

/// Neighbours by their names.
pub(super) fn links<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Link>, D::Error> {
    let written = BTreeMap::<String, WrittenPeer>::deserialize(from)?;
    let link = |(neighbour, WrittenPeer(settings))| Link { neighbour, settings };
    Ok(written.into_iter().map(link).collect())
}

/// An address, or a table with one: what stands for a peer in the file.
struct WrittenPeer(LinkSettings);

impl<'de> Deserialize<'de> for WrittenPeer {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Written;

        impl<'de> Visitor<'de> for Written {
            type Value = WrittenPeer;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an address such as \"10.0.0.2:7400\", or a table with one")
            }

            fn visit_str<E: de::Error>(self, address: &str) -> Result<WrittenPeer, E> {
                Ok(WrittenPeer(Remote::Written(address.to_owned()).into()))
            }

            fn visit_map<A: MapAccess<'de>>(self, table: A) -> Result<WrittenPeer, A::Error> {
                LinkSettings::deserialize(MapAccessDeserializer::new(table)).map(WrittenPeer)
            }
        }

        from.deserialize_any(Written)
    }
}

#[cfg(test)]
mod tests {
    use super::super::MediumKind;
    use super::*;
    use std::io::Write;

    const FILE: &str = r#"
keys = "module1.key"

[networks.ethernet]
endpoint = "udp://10.0.0.1:7400"
interface = "eth0"
medium = "satellite"
beacons = "239.255.0.1:7399"
discover = ["module4"]

[networks.ethernet.peers]
module2 = "10.0.0.2:7400"
module3 = { address = "10.0.0.3:7400", cost = 20, hello_every = "20ms", expected_within = "never" }

[networks.line]
endpoint = "serial:///dev/ttyUSB0"
insecure = true
peers = { module2 = "" }
"#;

    fn read(text: &str, overrides: &[&str]) -> Result<DescribedNetworks, String> {
        let mut file = tempfile::NamedTempFile::new().expect("a folder");
        file.write_all(text.as_bytes()).expect("it is ours");
        let overrides: Vec<_> = overrides.iter().map(|one| ("here", *one)).collect();
        described(Some(file.path()), &overrides)
    }

    #[test]
    fn a_file_describes_what_code_does() {
        let described = read(FILE, &[]).expect("it is right");
        let keys = described.keys.clone().expect("they are named");
        assert!(keys.is_absolute() && keys.ends_with("module1.key"), "{}", keys.display());
        let read: Vec<_> = described.into_networks().collect();
        let written = [
            Network::new("ethernet", "udp://10.0.0.1:7400")
                .interface("eth0")
                .medium(MediumKind::Satellite)
                .beacons("239.255.0.1:7399")
                .discover(["module4"])
                .peer("module2", "10.0.0.2:7400")
                .link(
                    Link::to("module3", "10.0.0.3:7400")
                        .cost(20)
                        .hello_every(Duration::from_millis(20))
                        .expected_within(Duration::MAX),
                ),
            Network::new("line", "serial:///dev/ttyUSB0").insecure().peer("module2", ""),
        ];
        assert_eq!(format!("{read:?}"), format!("{written:?}"));
        for (read, written) in read.iter().zip(&written) {
            assert_eq!(format!("{:?}", read.settings), format!("{:?}", written.settings));
        }
    }

    #[test]
    fn what_overrides_the_file_counts_in_its_order() {
        let overrides = [
            "networks.ethernet.endpoint = udp://127.0.0.1:1",
            "networks.ethernet.peers.module3.cost=30",
            "networks.ethernet.peers.module5=10.0.0.5:7400",
            "networks.line.insecure=false",
            "networks.ethernet.endpoint=udp://127.0.0.1:2",
        ];
        let described = read(FILE, &overrides).expect("it is right");
        let ethernet = &described.networks["ethernet"];
        assert_eq!(ethernet.endpoint, "udp://127.0.0.1:2");
        let peer = |name| ethernet.links.iter().find(|link| link.neighbour == name).expect(name);
        assert_eq!(peer("module3").settings.cost, Some(30));
        let address = &peer("module5").settings.address;
        assert!(matches!(address, Remote::Written(text) if text == "10.0.0.5:7400"));
        assert!(!described.networks["line"].insecure);
        // Without a file there is only what they say.
        let only = super::described(None, &[("here", overrides[0])]).expect("it is right");
        assert_eq!(only.networks.len(), 1);
    }

    #[test]
    fn what_is_wrong_is_shown_where_it_stands_and_with_what_to_write() {
        let refused = |from: &str, to: &str, overrides: &[&str], expected: &[&str]| {
            let error = read(&FILE.replace(from, to), overrides).expect_err(to);
            assert!(expected.iter().all(|part| error.contains(part)), "{error}");
        };
        refused("endpoint = \"udp", "endpont = \"udp", &[], &["line 5", "endpont", "`endpoint`"]);
        refused("cost = 20", "cots = 20", &[], &["line 13", "cots", "`cost`"]);
        refused("\"20ms\"", "\"20\"", &[], &["line 13", "`20` is no time", "20ms"]);
        refused("[\"module4\"]", "\"all\"", &[], &["line 9", "\"any\", or a list"]);
        refused("\"satellite\"", "\"moon\"", &[], &["line 7", "`moon`", "`satellite`"]);
        refused("= \"10.0.0.2:7400\"", "= 7", &[], &["line 12", "an address"]);
        refused("[networks.ethernet]", "[network.ethernet]", &[], &["network", "`networks`"]);
        refused("", "", &["networks.line"], &["here", "KEY=VALUE"]);
        refused("", "", &["networks..x=1"], &["here", "KEY=VALUE"]);
        refused("", "", &["keys.x=1"], &["here", "no table"]);
        refused("", "", &["networks.line.cost=1"], &["networks.line.cost=1", "unknown field"]);
        refused("", "", &["networks.radio.insecure=true"], &["missing field `endpoint`"]);
        let folder = tempfile::tempdir().expect("a folder");
        let error = described(Some(folder.path()), &[]).expect_err("a folder");
        assert!(error.contains("no regular file"), "{error}");
    }
}
