//! Names of hosts, where an IP address may stand.

use super::{Endpoint, EndpointError};
use std::net::SocketAddr;

/// The medium of an endpoint string is before this.
const BEHIND_MEDIUM: &str = "://";

/// The name of a host with its port in the text of an endpoint, such as `udp://arm.local:7400`, or
/// in that of a peer's address on such a medium, `arm.local:7400`.
///
/// ```
/// use blastema_transports::endpoint::NamedHost;
///
/// let named = NamedHost::find("udp://arm.local:7400?mtu=1400").expect("a name");
/// assert_eq!(named.name(), "arm.local:7400");
/// let (endpoint, _) = named.parse("10.0.0.2:7400".parse()?)?;
/// assert_eq!(endpoint.to_string(), "udp://10.0.0.2:7400");
/// assert!(NamedHost::find("10.0.0.2:7400").is_none());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct NamedHost<'a> {
    text: &'a str,
    start: usize,
    end: usize,
}

impl<'a> NamedHost<'a> {
    /// Finds it, if the text has one.
    pub fn find(text: &'a str) -> Option<Self> {
        let start = match text.split_once(BEHIND_MEDIUM) {
            Some((medium @ ("udp" | "tcp"), _)) => medium.len() + BEHIND_MEDIUM.len(),
            Some(_) => return None,
            None => 0,
        };
        let end = text[start..].find('?').map_or(text.len(), |length| start + length);
        let (host, port) = text[start..end].rsplit_once(':')?;
        port.parse::<u16>().ok().filter(|_| is_host(host))?;
        Some(NamedHost { text, start, end })
    }

    /// The name and the port.
    pub fn name(self) -> &'a str {
        &self.text[self.start..self.end]
    }

    /// Parses the text as an endpoint, with an address in place of the name.
    ///
    /// # Errors
    /// As [`Endpoint::parse`]; they show the text with the name.
    pub fn parse(self, address: SocketAddr) -> Result<(Endpoint, bool), EndpointError> {
        Endpoint::parse_at(self.text, Some(address))
    }
}

/// Whether a text can be the name of a host (RFC 1123), and no IP address that lacks a part.
fn is_host(text: &str) -> bool {
    let is_label = |label: &str| {
        let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
        (1..=63).contains(&label.len()) && label.bytes().all(is_allowed)
    };
    let text = text.strip_suffix('.').unwrap_or(text);
    let last = text.rsplit('.').next().unwrap_or_default();
    text.len() <= 253
        && text.split('.').all(is_label)
        && last.bytes().any(|byte| byte.is_ascii_alphabetic())
}
