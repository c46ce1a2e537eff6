//! Command 1 of each message, and the values in their data.
//!
//! A reply to a command has the same object and message, and one byte of [`Status`] before the
//! data that the table lists. An answer of the link begins with the first byte of its request: a
//! late answer to an earlier request is not mistaken for it.
//!
//! ```text
//! object 0          data to the device    data back
//! 00 PING           number 1              number 1, boot 1, flags 1, session 1
//! 01 HELLO          session 2,            session 1, boot 2, cause 1, type 4, max data 1,
//!                   dead-man ms 2         objects k 1, states k
//! 02 DESCRIBE       index 1               index 1, object 1, port 1, size 1, fingerprint 4; or
//!                                         index 1, END 1
//! 03 POLL           frames allowed 1      so many DATA or STATE at most, then PONG
//! 04 RESTART        type 4                type 1, status 1
//! objects 1-255
//! 10-13 life cycle  -                     state 1, also with the status WrongState or HookFailed
//! 14, 15, 16        -; -; period ms 2     -             START, STOP, RATE of the context
//! 20 STATE          (from the device)     state 1, code 1
//! 21 TEXT           code 1                at most 32 bytes
//! 40-5F WRITE       struct                -             of an in port; plain, or a command
//! 60-7F DATA, READ  -                     struct        of an out port; plain, or a command
//! 80-BF CALL        arguments             result
//! C0-DF SET         struct                -             of a variable
//! E0-FF GET         -                     struct        of a variable
//! ```
//!
//! Numbers are little-endian and structs packed.

/// Command 0 of messages that concern the link itself.
pub const LINK: u8 = 0;
/// Asks for a sign of life.
pub const PING: u8 = 0x00;
/// Opens a session.
pub const HELLO: u8 = 0x01;
/// Asks for one record of the port table.
pub const DESCRIBE: u8 = 0x02;
/// Gives a device of a multi-drop line the turn for what it has waiting.
pub const POLL: u8 = 0x03;
/// Restarts the chip.
pub const RESTART: u8 = 0x04;
/// The first of four messages of the life cycle, in the order of [`LifecycleChange`].
pub const LIFECYCLE: u8 = 0x10;
/// Starts the context, which runs `on_execute`.
pub const START: u8 = 0x14;
/// Stops the context.
pub const STOP: u8 = 0x15;
/// Sets the context's period.
pub const RATE: u8 = 0x16;
/// Reports that an object went into Error by itself.
pub const STATE: u8 = 0x20;
/// The longest period of a context, dead-man and deadline: a chip's clock of 16 bits wraps later.
pub const PERIOD_MAX_MS: u16 = 60_000;
/// Asks for the text of a fault's code.
pub const TEXT: u8 = 0x21;
/// The first in port.
pub const IN: u8 = 0x40;
/// The first out port.
pub const OUT: u8 = 0x60;
/// The first operation of a service.
pub const CALL: u8 = 0x80;
/// The first variable, to set it.
pub const SET: u8 = 0xC0;
/// The bit that turns SET into GET.
pub const GET_BIT: u8 = 0x20;
/// The most bytes of the text of a code.
pub const TEXT_MAX: usize = 32;

/// Bit of a PING's number: the host does not serve this device. Such a probe does not
/// restart the dead-man, so that a device whose answers do not arrive, or that is refused, is made
/// safe.
pub const PING_PROBE: u8 = 0x80;

/// Flag of a PONG: the device has a session.
pub const FLAG_SESSION: u8 = 1;
/// Flag of a PONG: the dead-man has expired in this session.
pub const FLAG_DEADMAN: u8 = 2;
/// Flag of a PONG on a multi-drop line: frames wait for a POLL.
pub const FLAG_WAITING: u8 = 4;

/// The code of a fault whose cause is that an in port's newest value is too old.
pub const CODE_INPUT_TOO_OLD: u8 = 0xFD;
/// The code of a fault whose cause is the host's silence.
pub const CODE_DEADMAN: u8 = 0xFE;

/// Defines an enum whose values travel as one byte.
macro_rules! byte_enum {
    ($(#[$doc:meta])* $name:ident { $($(#[$line:meta])* $variant:ident = $value:literal,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u8)]
        pub enum $name { $($(#[$line])* $variant = $value,)* }

        impl $name {
            /// The value of this byte, if there is one.
            pub const fn from_byte(byte: u8) -> Option<Self> {
                match byte {
                    $($value => Some($name::$variant),)*
                    _ => None,
                }
            }
        }
    };
}

byte_enum! {
    /// What became of a request.
    Status {
        /// It was carried out.
        Well = 0,
        /// The object's state does not allow the change.
        WrongState = 1,
        /// There is no such object, port or message.
        NoSuch = 2,
        /// The data have another length. No device of this crate sends it: data of a wrong length
        /// are a sign of line noise, and the packet is dropped.
        WrongLength = 3,
        /// The firmware's hook, or the operation, failed.
        HookFailed = 4,
        /// The device has no session.
        NoSession = 5,
        /// There is no record of this index.
        End = 6,
        /// The sequence is neither the last nor the next one; nothing was carried out.
        OutOfStep = 7,
    }
}

byte_enum! {
    /// The life-cycle state of one object of a device.
    DeviceState {
        /// `on_initialize` has not run.
        Created = 0,
        /// Initialized, at rest.
        Inactive = 1,
        /// `on_execute` runs at the context's period.
        Active = 2,
        /// `on_aborting` has run; a reset leads back to Inactive.
        Error = 3,
        /// The end, also of a failed initialization.
        Finalized = 4,
    }
}

byte_enum! {
    /// A change of the life-cycle state that the host orders.
    LifecycleChange {
        /// Inactive to Active.
        Activate = 0,
        /// Active to Inactive.
        Deactivate = 1,
        /// Error to Inactive.
        Reset = 2,
        /// Inactive to Finalized.
        Finalize = 3,
    }
}

byte_enum! {
    /// Why a chip began its present incarnation.
    ResetCause {
        /// The chip cannot tell, or the boot loader has cleared the register.
        Unknown = 0,
        /// The supply was switched on.
        PowerOn = 1,
        /// The reset pin.
        External = 2,
        /// The supply was too low.
        BrownOut = 3,
        /// The hardware watchdog: a hook hung.
        Watchdog = 4,
        /// The program, for example by RESTART.
        Software = 5,
        /// The handler of a hardware fault.
        FaultHandler = 6,
    }
}
