//! The media that an endpoint may name.

use super::EndpointProblem;
use blastema_core::suggestion::nearest;

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
    ("memory", "network", true),
];

/// The medium of this name.
pub(super) fn find(known: &[KnownMedium], name: &str) -> Result<&'static str, EndpointProblem> {
    match known.iter().find(|(medium, ..)| *medium == name) {
        Some((medium, _, true)) => Ok(medium),
        Some((medium, feature, false)) => Err(EndpointProblem::NotCompiled { medium, feature }),
        None => {
            let media = known.iter().filter(|(_, _, is_compiled)| *is_compiled);
            let media = media.map(|(medium, ..)| *medium);
            Err(EndpointProblem::UnknownMedium {
                found: name.to_owned(),
                nearest: nearest(name, media.clone()).map(str::to_owned),
                known: media.map(str::to_owned).collect(),
            })
        }
    }
}
