//! What the author of a device's firmware writes.

use crate::PortSet;

/// A hook of an object's life cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceHook {
    /// Once, at the start.
    Initialize,
    /// Before the object becomes Active.
    Activated,
    /// While it is Active, at the context's period.
    Execute,
    /// Before it becomes Inactive.
    Deactivated,
    /// When it goes into Error; `why` is the code. Must set safe outputs.
    Aborting,
    /// While it is in Error, at the context's period; `why` is the code.
    Error,
    /// Before it leaves Error.
    Reset,
    /// Before it becomes Finalized.
    Finalize,
}

/// The hooks and values of a device.
///
/// Objects count from 1; ports are indices of the table in
/// [`DeviceConfig::ports`](crate::DeviceConfig::ports). Slices have exactly the sizes of that
/// table.
pub trait Firmware {
    /// Runs a hook. The result is 0, or the code of a fault, 1 to 0xEF: then the object goes into
    /// Error by way of [`DeviceHook::Aborting`]. The code of a failed
    /// [`Initialize`](DeviceHook::Initialize) finalizes the object. A hook publishes an out port by
    /// inserting it into `published`.
    fn hook(&mut self, object: u8, hook: DeviceHook, why: u8, published: &mut PortSet) -> u8;

    /// Writes the packed struct of an out port or variable into `value`.
    fn read(&mut self, port: usize, value: &mut [u8]);

    /// Takes the packed struct of an in port or variable.
    fn write(&mut self, port: usize, value: &[u8]);

    /// Carries out an operation; false if it failed.
    fn call(&mut self, port: usize, arguments: &[u8], result: &mut [u8]) -> bool;

    /// The text of a fault's code; the first 32 bytes are sent.
    fn text(&self, _object: u8, _code: u8) -> &str {
        ""
    }
}
