//! Sender and receiver on a bus without addresses: both are encoded in the identifier.
//!
//! ```text
//! 29 bits, the "normal fixed" addressing of ISO 15765-2, which leaves room for J1939 beside it:
//!   28    26 25    24 23        16 15       8 7        0
//! ┌─────────┬────────┬────────────┬──────────┬──────────┐
//! │priority │   0    │ DA: to one │  target  │  source  │   DB: to all
//! └─────────┴────────┴────────────┴──────────┴──────────┘
//!
//! 11 bits, for buses and adapters that know no others; 31 is "all":
//!   10  9        5 4        0
//! ┌───┬──────────┬──────────┐
//! │ 1 │  target  │  source  │
//! └───┴──────────┴──────────┘
//! ```

use super::frame::CanId;
use std::fmt;

const TO_ONE: u32 = 0xda;
const TO_ALL: u32 = 0xdb;
/// All nodes, where five bits name one.
const ALL_OF_FIVE_BITS: u32 = 0x1f;
const SHORT: u32 = 0x400;

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

/// How addresses are written into identifiers. All nodes of a bus do it alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Addressing {
    /// 29 bits: addresses 0 to 254.
    Extended {
        /// 0 to 7; the lowest goes first where several speak at once. ISO 15765-2 recommends 6, so
        /// that what controls a machine goes before what is longer than a frame.
        priority: u8,
    },
    /// 11 bits, the upper half of the identifiers: addresses 0 to 30.
    Standard,
}

impl Default for Addressing {
    fn default() -> Self {
        Addressing::Extended { priority: 6 }
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

impl Addressing {
    /// Whether a node can have this address.
    pub fn names(self, address: BusAddress) -> bool {
        match self {
            Addressing::Extended { .. } => address != BusAddress::ALL,
            Addressing::Standard => u32::from(address.0) < ALL_OF_FIVE_BITS,
        }
    }

    /// The identifier; `None` for an address that no node can have here.
    pub fn id(self, parties: AddressInfo) -> Option<CanId> {
        let AddressInfo { source, target } = parties;
        let to_all = target == BusAddress::ALL;
        if !self.names(source) || !to_all && !self.names(target) {
            return None;
        }
        let (from, to) = (u32::from(source.0), u32::from(target.0));
        match self {
            Addressing::Extended { priority } => {
                let kind = if to_all { TO_ALL } else { TO_ONE };
                CanId::extended(u32::from(priority & 7) << 26 | kind << 16 | to << 8 | from)
            }
            Addressing::Standard => {
                let to = if to_all { ALL_OF_FIVE_BITS } else { to };
                CanId::standard(SHORT | to << 5 | from)
            }
        }
    }

    /// Who speaks to whom; `None` for an identifier that other things on the bus use. The priority
    /// is the speaker's business.
    pub fn parties(self, id: CanId) -> Option<AddressInfo> {
        let number = id.number();
        let (to_all, target, source) = match (self, id.is_extended()) {
            (Addressing::Extended { .. }, true) => {
                let kind = number >> 16 & 0x3ff;
                let target = number >> 8 & 0xff;
                // "To one" with an address that no node has, or "to all" of some group: not ours.
                let to_all = match kind {
                    TO_ONE if target != 0xff => false,
                    TO_ALL if target == 0xff => true,
                    _ => return None,
                };
                (to_all, target, number & 0xff)
            }
            (Addressing::Standard, false) if number & SHORT != 0 => {
                let target = number >> 5 & 0x1f;
                (target == ALL_OF_FIVE_BITS, target, number & 0x1f)
            }
            _ => return None,
        };
        let source = BusAddress(source as u8);
        let target = if to_all { BusAddress::ALL } else { BusAddress(target as u8) };
        self.names(source).then_some(AddressInfo { source, target })
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
        let check = |addressing: Addressing, who: AddressInfo, expected: u32| {
            let id = addressing.id(who).unwrap();
            assert_eq!(id.number(), expected, "{who:?}");
            assert_eq!(addressing.parties(id), Some(who));
        };
        let extended = Addressing::default();
        check(extended, parties(0xf1, 0x10), 0x18da_10f1);
        check(extended, parties(3, 0xff), 0x18db_ff03);
        check(Addressing::Extended { priority: 0 }, parties(1, 2), 0x00da_0201);
        check(Addressing::Standard, parties(1, 2), 0x441);
        check(Addressing::Standard, parties(30, 0xff), 0x7fe);
    }

    #[test]
    fn a_priority_other_than_ours_is_understood() {
        let id = Addressing::Extended { priority: 3 }.id(parties(1, 2)).unwrap();

        assert_eq!(Addressing::default().parties(id), Some(parties(1, 2)));
    }

    #[test]
    fn every_identifier_is_of_one_pair_or_of_nobody() {
        let mut ours = 0;
        for number in 0..0x800 {
            let id = CanId::standard(number).unwrap();
            assert_eq!(Addressing::default().parties(id), None);
            if let Some(who) = Addressing::Standard.parties(id) {
                assert_eq!(Addressing::Standard.id(who), Some(id));
                ours += 1;
            }
        }
        assert_eq!(ours, 31 * 32);
        for number in (0..0x2000_0000).step_by(97) {
            let id = CanId::extended(number).unwrap();
            assert_eq!(Addressing::Standard.parties(id), None);
            if let Some(who) = Addressing::default().parties(id) {
                let priority = (number >> 26) as u8;
                assert_eq!(Addressing::Extended { priority }.id(who), Some(id));
            }
        }
    }

    #[test]
    fn an_address_that_nobody_can_have_has_no_identifier() {
        assert_eq!(Addressing::default().id(parties(0xff, 1)), None);
        assert_eq!(Addressing::Standard.id(parties(31, 1)), None);
        assert_eq!(Addressing::Standard.id(parties(1, 31)), None);
        assert!(Addressing::Standard.names(BusAddress(30)));
    }
}
