//! Names of contracts and hooks as numbers, so that an activity record can say in one store what is
//! in service.

use std::sync::{Mutex, PoisonError};

/// While a condition of the component runs.
pub(crate) const CONDITION: &str = "a condition of a subscription";
/// While the component is built.
pub(crate) const FACTORY: &str = "its factory";
/// While one of its tasks runs.
pub(crate) const TASK: &str = "a task of its own";
/// While one of its timers runs.
pub(crate) const TIMER: &str = "a timer";

/// Bounded by the contracts of the program: only names that are `'static` come here.
static NAMES: Mutex<Vec<&'static str>> = Mutex::new(Vec::new());

/// The number of this name.
pub(crate) fn label(name: &'static str) -> u32 {
    let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    // A name mostly comes from the same place again, which is compared faster than its letters.
    let same = names.iter().position(|known| std::ptr::eq(*known, name));
    let equal = || names.iter().position(|known| *known == name);
    let at = same.or_else(equal).unwrap_or_else(|| {
        names.push(name);
        names.len() - 1
    });
    u32::try_from(at).expect("a program has fewer than four thousand million contracts")
}

/// The name of this number.
pub(crate) fn name(label: u32) -> &'static str {
    let names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    names.get(label as usize).copied().unwrap_or("nothing")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_stands_for_one_name() {
        let one = label("test/one");
        assert_eq!(label("test/one"), one);
        assert_ne!(label("test/two"), one);
        assert_eq!(name(one), "test/one");
        assert_eq!(name(u32::MAX), "nothing");
    }
}
