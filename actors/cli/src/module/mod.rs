//! One module of the demonstration's robot.

use crate::args::ModuleOptions;

pub(crate) fn run(_options: &ModuleOptions) -> Result<(), std::io::Error> {
    Ok(())
}
