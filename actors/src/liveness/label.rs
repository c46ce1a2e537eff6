//! Names of contracts and hooks as numbers, so that an activity record can say in one store what is
//! in service.

use crate::platform::lock;
use std::sync::{Mutex, OnceLock};

/// While a condition of the component runs.
pub(crate) static CONDITION: Label = Label::new("a condition of a subscription");
/// While the component is built.
pub(crate) static FACTORY: Label = Label::new("its factory");
/// While one of its tasks runs.
pub(crate) const TASK: &str = "a task of its own";
/// While one of its timers runs.
pub(crate) static TIMER: Label = Label::new("a timer");

/// Bounded by the contracts of the program: only names that are `'static` come here.
static NAMES: Mutex<Vec<&'static str>> = Mutex::new(Vec::new());

/// A name whose number is looked up once.
#[derive(Debug)]
pub(crate) struct Label {
    pub(crate) name: &'static str,
    number: OnceLock<u32>,
}

impl Label {
    pub(crate) const fn new(name: &'static str) -> Self {
        Label { name, number: OnceLock::new() }
    }

    #[inline]
    pub(crate) fn number(&self) -> u32 {
        *self.number.get_or_init(|| number(self.name))
    }
}

/// The number of this name.
pub(crate) fn number(name: &'static str) -> u32 {
    let mut names = lock(&NAMES);
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
pub(crate) fn name(number: u32) -> &'static str {
    let names = lock(&NAMES);
    names.get(number as usize).copied().unwrap_or("nothing")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_stands_for_one_name() {
        let one = number("test/one");
        assert_eq!(number("test/one"), one);
        assert_eq!(Label::new("test/one").number(), one);
        assert_ne!(number("test/two"), one);
        assert_eq!(name(one), "test/one");
        assert_eq!(name(u32::MAX), "nothing");
    }
}
