//! The media that an endpoint may name.

use super::error::suggest;

/// A medium, the feature of the package `blastema` that it needs, and whether this program was
/// built with it.
pub(super) type KnownMedium = (&'static str, &'static str, bool);

pub(super) const MEDIA: [KnownMedium; 7] = [
    ("udp", "ip", cfg!(feature = "udp")),
    ("tcp", "ip", cfg!(feature = "tcp")),
    ("unix", "unix", cfg!(feature = "unix")),
    ("serial", "serial", cfg!(feature = "serial")),
    ("can", "can", cfg!(feature = "can")),
    ("slcan", "slcan", cfg!(feature = "slcan")),
    ("memory", "", true),
];

/// The medium of this name.
pub(super) fn find(known: &[KnownMedium], name: &str) -> Result<&'static str, String> {
    match known.iter().find(|(medium, ..)| *medium == name) {
        Some((medium, _, true)) => Ok(medium),
        Some((medium, feature, false)) => Err(format!(
            "this program was built without `{medium}`: add the feature `{feature}` to the \
             dependency on blastema"
        )),
        None => {
            let media = known.iter().filter(|(_, _, is_compiled)| *is_compiled);
            let media: Vec<_> = media.map(|(medium, ..)| *medium).collect();
            Err(format!("no medium is called `{name}`: {}", suggest(name, &media)))
        }
    }
}
