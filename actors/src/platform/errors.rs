//! How errors are shown to a person: by their texts, with their causes, and never by `Debug`.

use std::error::Error;
use std::process::ExitCode;

/// The text of an error, and those of its causes that it does not repeat itself.
pub(crate) fn with_causes(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let named = error.to_string();
        if !text.contains(&named) {
            text.push_str(": ");
            text.push_str(&named);
        }
        cause = error.source();
    }
    text
}

/// The error that ends a program; made by [`main`](macro@crate::main).
#[derive(Debug)]
pub struct Fatal<E>(pub E);

impl<E: Into<Box<dyn Error>>> Fatal<E> {
    /// Prints the error with its causes on standard error, and returns the exit code of a failure.
    pub fn report(self) -> ExitCode {
        report(&*self.0.into())
    }
}

/// What [`Fatal`] does with the one common error that is not `Into<Box<dyn Error>>`.
pub trait ReportBoxed {
    /// As [`Fatal::report`].
    fn report(self) -> ExitCode;
}

impl ReportBoxed for Fatal<Box<dyn Error + Send + Sync>> {
    fn report(self) -> ExitCode {
        report(&*self.0)
    }
}

#[expect(clippy::print_stderr, reason = "the last words of a program are for who started it")]
fn report(error: &dyn Error) -> ExitCode {
    eprintln!("Error: {}", with_causes(error));
    ExitCode::FAILURE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Failure;

    #[derive(Debug, thiserror::Error)]
    #[error("the motor driver does not start")]
    struct Outer(#[source] Middle);

    #[derive(Debug, thiserror::Error)]
    #[error("its port is closed: {0}")]
    struct Middle(#[source] std::io::Error);

    #[test]
    fn a_failure_keeps_the_text_of_each_cause_once() {
        fn hook() -> Result<(), Failure> {
            Err(Outer(Middle(std::io::Error::other("no such device"))))?;
            Ok(())
        }

        let failure = hook().unwrap_err();

        let expected = "the motor driver does not start: its port is closed: no such device";
        assert_eq!(failure, Failure { reason: expected.into(), fatal: false, unavailable: false });
    }

    #[test]
    fn a_text_and_a_boxed_error_are_failures_too() {
        let boxed: Box<dyn Error> = "it is dark".into();
        for failure in
            ["it is dark".into(), String::from("it is dark").into(), Failure::from(boxed)]
        {
            assert_eq!(failure.reason, "it is dark");
        }
    }
}
