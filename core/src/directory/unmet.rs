//! Components that go without the names that they claim.

use crate::ObjectName;
use crate::sorted::SortedMap;

/// The most of them that are named: what helps the first ones helps all.
const NAMED_MAX: usize = 8;

/// The components that lack a name that they claim, and why. No caller waits for the result of a
/// component's claim: as long as there is an entry, it is a fault.
#[derive(Clone, Debug, Default)]
pub struct UnmetClaims {
    /// By the name and the number of the claim, the component and the reason; as many as components
    /// here claim.
    cases: SortedMap<(ObjectName, u64), (ObjectName, String)>,
}

impl UnmetClaims {
    /// A claim of this component was refused, for this reason.
    pub fn handle_refused(&mut self, claim: (ObjectName, u64), object: ObjectName, why: String) {
        self.cases.insert(claim, (object, why));
    }

    /// The component has the name, or has ended.
    pub fn handle_end(&mut self, name: &ObjectName, number: u64) {
        self.cases.remove(&(name.clone(), number));
    }

    /// All that is to be said now.
    pub fn text(&self) -> Option<String> {
        let named = self.cases.iter().take(NAMED_MAX).map(|((name, _), (object, why))| {
            format!("{object} goes without the name {name}: {why}")
        });
        let named: Vec<_> = named.collect();
        let more = self.cases.len() - named.len();
        let more = if more > 0 { format!("; and {more} more") } else { String::new() };
        (!named.is_empty()).then(|| named.join("; ") + &more)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> ObjectName {
        ObjectName::new(text).unwrap()
    }

    #[test]
    fn all_are_named_who_go_without_and_no_others() {
        let mut without = UnmetClaims::default();
        assert_eq!(without.text(), None);
        without.handle_refused((name("map"), 1), name("one"), "it is held".to_owned());
        without.handle_refused((name("map"), 2), name("two"), "one has it".to_owned());
        let text = "one goes without the name map: it is held; \
                    two goes without the name map: one has it";
        assert_eq!(without.text().as_deref(), Some(text));

        without.handle_end(&name("map"), 1);
        assert_eq!(without.text().unwrap(), "two goes without the name map: one has it");
        without.handle_end(&name("map"), 2);
        assert_eq!(without.text(), None);
    }

    #[test]
    fn of_many_the_first_are_named() {
        let mut without = UnmetClaims::default();
        for n in 0..100 {
            without.handle_refused((name("map"), n), name("one"), "it is held".to_owned());
        }
        assert!(without.text().unwrap().ends_with("; and 92 more"));
    }
}
