//! Sender and receiver on a bus without addresses: both are encoded in the identifier.
//!
//! ```text
//! 29 bits, the "normal fixed" addressing of ISO 15765-2, which leaves room for J1939 beside it:
//!   28    26 25    24 23        16 15       8 7        0
//! ┌─────────┬────────┬────────────┬──────────┬──────────┐
//! │priority │   0    │ DA: to one │  target  │  source  │   DB: to all
//! └─────────┴────────┴────────────┴──────────┴──────────┘
//! ```

use super::frame::CanId;
use std::fmt;

const TO_ONE: u32 = 0xda;
const TO_ALL: u32 = 0xdb;
/// As ISO 15765-2 recommends, so that what controls a machine goes before what is longer than a
/// frame.
const PRIORITY: u32 = 6;

/// A node's number on its bus. Two nodes on one bus must not share one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BusAddress(pub u8);

impl BusAddress {
    /// All nodes on the bus.
    pub const ALL: BusAddress = BusAddress(0xff);
}

impl fmt::Display for BusAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            BusAddress::ALL => write!(f, "all"),
            BusAddress(number) => write!(f, "{number}"),
        }
    }
}

/// What an identifier says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AddressInfo {
    /// The address of the sender.
    pub source: BusAddress,
    /// The address of the receiver, or [`BusAddress::ALL`].
    pub target: BusAddress,
}

impl AddressInfo {
    /// The identifier; `None` where no node can have the sender's address.
    pub fn id(self) -> Option<CanId> {
        let AddressInfo { source, target } = self;
        let kind = if target == BusAddress::ALL { TO_ALL } else { TO_ONE };
        let (from, to) = (u32::from(source.0), u32::from(target.0));
        let id = CanId::extended(PRIORITY << 26 | kind << 16 | to << 8 | from);
        id.filter(|_| source != BusAddress::ALL)
    }

    /// Who speaks to whom; `None` for an identifier that other things on the bus use. The priority
    /// is the speaker's business.
    pub fn of(id: CanId) -> Option<AddressInfo> {
        let number = id.number();
        let [_, _, target, source] = number.to_be_bytes().map(BusAddress);
        // "To one" with an address that no node has, or "to all" of some group: not ours.
        let is_ours = match number >> 16 & 0x3ff {
            TO_ONE => target != BusAddress::ALL,
            TO_ALL => target == BusAddress::ALL,
            _ => false,
        };
        let is_node = source != BusAddress::ALL;
        (id.is_extended() && is_ours && is_node).then_some(AddressInfo { source, target })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parties(source: u8, target: u8) -> AddressInfo {
        AddressInfo { source: BusAddress(source), target: BusAddress(target) }
    }

    #[test]
    fn the_identifiers_are_these_for_ever_and_are_read_back() {
        let check = |who: AddressInfo, expected: u32| {
            let id = who.id().unwrap();
            assert_eq!(id.number(), expected, "{who:?}");
            assert_eq!(AddressInfo::of(id), Some(who));
        };
        check(parties(0xf1, 0x10), 0x18da_10f1);
        check(parties(3, 0xff), 0x18db_ff03);
    }

    #[test]
    fn a_priority_other_than_ours_is_understood() {
        let id = CanId::extended(0x0cda_0201).unwrap();

        assert_eq!(AddressInfo::of(id), Some(parties(1, 2)));
    }

    #[test]
    fn every_identifier_is_of_one_pair_or_of_other_things() {
        for number in 0..0x800 {
            assert_eq!(AddressInfo::of(CanId::standard(number).unwrap()), None);
        }
        for number in (0..0x2000_0000).step_by(97) {
            if let Some(who) = AddressInfo::of(CanId::extended(number).unwrap()) {
                let without_priority = |id: CanId| id.number() & 0x03ff_ffff;
                assert_eq!(who.id().map(without_priority), Some(number & 0x03ff_ffff));
            }
        }
    }

    #[test]
    fn an_address_that_no_node_can_have_has_no_identifier() {
        assert_eq!(parties(0xff, 1).id(), None);
    }
}
