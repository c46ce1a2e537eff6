//! Ports and variables of a device, as both sides list them.

use crate::message;

/// The most ports and variables of a device: DESCRIBE has an index of one byte.
pub const PORTS_MAX: usize = 255;

/// One port or variable of a device: one record of DESCRIBE, and the length of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Port {
    object: u8,
    id: u8,
    size: u8,
    reply: u8,
    fingerprint: u32,
    deadline_ms: u16,
}

/// What a [`Port`] is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PortKind {
    /// A data port that the host writes.
    In,
    /// A data port that the device publishes.
    Out,
    /// An operation of a service port.
    Call,
    /// A variable that the host sets and reads.
    Variable,
}

impl Port {
    /// The in port `number`, below 32, of an object, whose struct has `size` bytes.
    ///
    /// # Panics
    ///
    /// This function and its siblings panic if the number is too large, or a size exceeds 239
    /// bytes: a status stands before it in replies.
    ///
    /// ```
    /// use blastema_lite::{Port, PortKind};
    /// const FORCE: Port = Port::input(1, 0, 4, 0x1234_abcd);
    /// assert_eq!((FORCE.kind(), FORCE.id(), FORCE.size()), (PortKind::In, 0x40, 4));
    /// ```
    pub const fn input(object: u8, number: u8, size: u8, fingerprint: u32) -> Port {
        assert!(number < 32, "an object has at most 32 in ports");
        Port::new(object, message::IN + number, size, 0, fingerprint)
    }

    /// The out port `number`, below 32.
    pub const fn output(object: u8, number: u8, size: u8, fingerprint: u32) -> Port {
        assert!(number < 32, "an object has at most 32 out ports");
        Port::new(object, message::OUT + number, size, 0, fingerprint)
    }

    /// The operation `number`, below 64, with the sizes of its arguments and of its result.
    pub const fn call(object: u8, number: u8, size: u8, reply: u8, fingerprint: u32) -> Port {
        assert!(number < 64, "an object has at most 64 operations");
        Port::new(object, message::CALL + number, size, reply, fingerprint)
    }

    /// The variable `number`, below 32.
    pub const fn variable(object: u8, number: u8, size: u8, fingerprint: u32) -> Port {
        assert!(number < 32, "an object has at most 32 variables");
        Port::new(object, message::SET + number, size, 0, fingerprint)
    }

    const fn new(object: u8, id: u8, size: u8, reply: u8, fingerprint: u32) -> Port {
        assert!(object > 0, "object 0 is the link");
        assert!(size < 240 && reply < 240, "a struct has at most 239 bytes");
        Port { object, id, size, reply, fingerprint, deadline_ms: 0 }
    }

    /// The fields of a record of DESCRIBE. Nothing is checked: the record came from outside.
    pub(crate) const fn from_record(object: u8, id: u8, size: u8, fingerprint: u32) -> Port {
        Port { object, id, size, reply: 0, fingerprint, deadline_ms: 0 }
    }

    /// An in port whose newest value may be so old, in milliseconds, while its object is Active;
    /// an older one is a fault of the object. 0 for no limit.
    ///
    /// # Panics
    ///
    /// If it is above [`PERIOD_MAX_MS`](message::PERIOD_MAX_MS), or the port is no in port.
    pub const fn with_deadline_ms(mut self, deadline_ms: u16) -> Port {
        assert!(deadline_ms <= message::PERIOD_MAX_MS, "a chip's clock wraps at 65,536 ms");
        assert!(matches!(self.kind(), PortKind::In), "only in ports have deadlines");
        self.deadline_ms = deadline_ms;
        self
    }

    /// The object that it belongs to, from 1.
    pub const fn object(&self) -> u8 {
        self.object
    }

    /// Command 1 of its message; of a variable that of SET.
    pub const fn id(&self) -> u8 {
        self.id
    }

    /// Bytes of its struct; of an operation those of the arguments.
    pub const fn size(&self) -> u8 {
        self.size
    }

    /// Bytes of an operation's result; 0 otherwise.
    pub const fn reply(&self) -> u8 {
        self.reply
    }

    /// The low 32 bits of a hash over the packed layout.
    pub const fn fingerprint(&self) -> u32 {
        self.fingerprint
    }

    /// How old an in port's newest value may be; 0 for no limit.
    pub const fn deadline_ms(&self) -> u16 {
        self.deadline_ms
    }

    /// What it is.
    pub const fn kind(&self) -> PortKind {
        match self.id {
            message::SET.. => PortKind::Variable,
            message::CALL.. => PortKind::Call,
            message::OUT.. => PortKind::Out,
            _ => PortKind::In,
        }
    }

    /// The index of the port or variable that this message of this object concerns.
    pub(crate) fn find(ports: &[Port], object: u8, message: u8) -> Option<usize> {
        let id = if message >= message::SET { message & !message::GET_BIT } else { message };
        ports.iter().position(|port| (port.object, port.id) == (object, id))
    }
}

/// A set of ports, by their index in the table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PortSet([u32; 8]);

impl PortSet {
    /// Adds a port; an index of 256 and above is ignored.
    pub fn insert(&mut self, port: usize) {
        if let Some(word) = self.0.get_mut(port / 32) {
            *word |= 1 << (port % 32);
        }
    }

    /// Whether the port is in the set.
    pub fn contains(&self, port: usize) -> bool {
        self.0.get(port / 32).is_some_and(|word| word & 1 << (port % 32) != 0)
    }

    /// Whether no port is in the set.
    pub fn is_empty(&self) -> bool {
        self.0 == [0; 8]
    }

    /// Takes out the port with the lowest index.
    pub fn pop(&mut self) -> Option<usize> {
        let (at, word) = self.0.iter_mut().enumerate().find(|(_, word)| **word != 0)?;
        let bit = word.trailing_zeros() as usize;
        *word &= *word - 1;
        Some(at * 32 + bit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_gives_back_its_ports_in_order() {
        let mut set = PortSet::default();
        [254, 0, 31, 32, 300].into_iter().for_each(|port| set.insert(port));
        assert!(set.contains(31) && !set.contains(30) && !set.contains(300));
        assert_eq!([(); 5].map(|()| set.pop()), [Some(0), Some(31), Some(32), Some(254), None]);
        assert!(set.is_empty());
    }

    #[test]
    fn both_messages_of_a_variable_find_it() {
        let ports = [Port::output(1, 2, 1, 0), Port::variable(2, 3, 1, 0)];
        assert_eq!(Port::find(&ports, 2, 0xC3), Some(1));
        assert_eq!(Port::find(&ports, 2, 0xE3), Some(1));
        assert_eq!(Port::find(&ports, 1, 0x62), Some(0));
        assert_eq!(Port::find(&ports, 1, 0x42), None);
        assert_eq!(ports.map(|port| port.kind()), [PortKind::Out, PortKind::Variable]);
    }
}
