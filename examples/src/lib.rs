//! Robot modules, one lesson a file. What several of them need to run on one computer is here.

use std::io;
use std::net::{SocketAddr, UdpSocket};

/// Finds addresses of this computer that are free.
///
/// # Errors
///
/// If the computer has no loopback interface, or no free port.
pub fn free_addresses<const N: usize>() -> io::Result<[SocketAddr; N]> {
    // Held together, so that they differ, and given back for the nodes to take.
    let held = [0; N].map(|_| UdpSocket::bind("127.0.0.1:0"));
    let mut addresses = [SocketAddr::from(([127, 0, 0, 1], 0)); N];
    for (address, socket) in addresses.iter_mut().zip(held) {
        *address = socket?.local_addr()?;
    }
    Ok(addresses)
}
