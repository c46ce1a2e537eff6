//! Where the ends of the cables are.

use super::robot::{CABLES, DemoCable, Module};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io;
use std::net::{SocketAddr, UdpSocket};

/// The address of both ends of each cable: module1's, then the far module's.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct CableAddresses(BTreeMap<String, [SocketAddr; 2]>);

/// One cable, seen from one of its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CableEnd {
    /// The cable.
    pub(crate) cable: DemoCable,
    /// Our address.
    pub(crate) here: SocketAddr,
    /// The address at the other end.
    pub(crate) there: SocketAddr,
    /// Who is at the other end.
    pub(crate) neighbour: Module,
}

impl CableAddresses {
    /// Chooses a free port for every end.
    ///
    /// Another process may take one before the module opens it; the module then says so and the
    /// director chooses again.
    ///
    /// # Errors
    /// The system refuses to open a socket on the loopback addresses.
    pub(crate) fn choose() -> io::Result<CableAddresses> {
        // All are held open until all are chosen, so that none is given out twice.
        let mut held = Vec::new();
        let mut ends = BTreeMap::new();
        for cable in CABLES {
            let [near, far] = cable.ends().map(|module| cable.network.address(module));
            let [near, far] = [UdpSocket::bind((near, 0))?, UdpSocket::bind((far, 0))?];
            // An interface that is down lets sockets be bound and nothing be sent.
            near.send_to(&[0], far.local_addr()?)?;
            ends.insert(cable.name.to_owned(), [near.local_addr()?, far.local_addr()?]);
            held.extend([near, far]);
        }
        Ok(CableAddresses(ends))
    }

    /// The cable ends of a module.
    pub(crate) fn ends_of(&self, module: Module) -> Vec<CableEnd> {
        let end = |cable: DemoCable| {
            let &[near, far] = self.0.get(cable.name)?;
            Some(match module {
                Module::Module1 => CableEnd { cable, here: near, there: far, neighbour: cable.far },
                _ => CableEnd { cable, here: far, there: near, neighbour: Module::Module1 },
            })
        };
        CABLES.into_iter().filter(|cable| cable.touches(module)).filter_map(end).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_two_ends_of_a_cable_know_each_other_and_no_address_is_given_twice() {
        let wiring = CableAddresses::choose().expect("loopback sockets can be opened");
        let ends: Vec<_> =
            Module::ALL.into_iter().flat_map(|module| wiring.ends_of(module)).collect();

        assert_eq!(ends.len(), 2 * CABLES.len());
        for end in &ends {
            let twins = ends.iter().filter(|other| other.here == end.there);
            let twins: Vec<_> = twins.filter(|other| other.there == end.here).collect();
            assert_eq!(twins.len(), 1, "{end:?}");
            assert_eq!(twins[0].cable, end.cable);
            assert_eq!(ends.iter().filter(|other| other.here == end.here).count(), 1);
        }
    }
}
