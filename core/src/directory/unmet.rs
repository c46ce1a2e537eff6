//! Components that go without the names that they claim.

use super::types::{ClaimRefused, Holder};
use crate::ObjectName;
use crate::sorted::SortedMap;

/// The most of them that are named: what helps the first ones helps all.
const NAMED_MAX: usize = 8;

/// The components that lack a name that they claim, and why. No caller waits for the result of a
/// component's claim: as long as there is an entry, it is a fault.
#[derive(Clone, Debug, Default)]
pub struct UnmetClaims {
    /// By the name and the number of the claim; as many as components here claim.
    cases: SortedMap<(ObjectName, u64), Case>,
}

#[derive(Clone, Debug)]
struct Case {
    object: ObjectName,
    why: String,
    /// It is because of a holder, who may change.
    held: bool,
}

impl UnmetClaims {
    /// A claim of this component's was refused.
    pub fn handle_refused(
        &mut self,
        name: ObjectName,
        number: u64,
        object: ObjectName,
        refused: &ClaimRefused,
    ) {
        let held = matches!(refused, ClaimRefused::Held(_));
        self.cases.insert((name, number), Case { object, why: refused.to_string(), held });
    }

    /// Another component of this node claims the name already.
    pub fn handle_doubled(
        &mut self,
        name: ObjectName,
        number: u64,
        object: ObjectName,
        other: &ObjectName,
    ) {
        let why =
            format!("{other} of this node claims it too: one of the two is to take another name");
        self.cases.insert((name, number), Case { object, why, held: true });
    }

    /// The name has another holder than before, or none.
    pub fn handle_holder(&mut self, name: &ObjectName, holder: Option<&Holder>) {
        let cases = self.cases.range_mut((name.clone(), 0)..=(name.clone(), u64::MAX));
        for (_, case) in cases.filter(|(_, case)| case.held) {
            case.why = match holder {
                Some(holder) => {
                    let epoch = holder.epoch;
                    format!(
                        "{name} is claimed by {holder}, under epoch {epoch}: stand by, or take \
                         another name"
                    )
                }
                None => {
                    let object = &case.object;
                    format!("it has no holder now: restart {object}, or let it stand by for it")
                }
            };
        }
    }

    /// The component has the name, or has ended.
    pub fn handle_end(&mut self, name: &ObjectName, number: u64) {
        self.cases.remove(&(name.clone(), number));
    }

    /// All that is to be said now.
    pub fn text(&self) -> Option<String> {
        let case = |((name, _), Case { object, why, .. }): (&(ObjectName, u64), &Case)| {
            format!("{object} goes without the name {name}: {why}")
        };
        let named: Vec<_> = self.cases.iter().take(NAMED_MAX).map(case).collect();
        let more = self.cases.len() - named.len();
        let more = if more > 0 { format!("; and {more} more") } else { String::new() };
        (!named.is_empty()).then(|| named.join("; ") + &more)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NodeName;
    use crate::directory::NameHeld;
    use crate::testing::object;

    fn held(by: &str) -> ClaimRefused {
        let holder = NodeName::new(by).unwrap();
        NameHeld { name: object("map"), holder, epoch: 7 }.into()
    }

    #[test]
    fn all_are_named_who_go_without_and_no_others() {
        let mut without = UnmetClaims::default();
        assert_eq!(without.text(), None);
        without.handle_refused(object("map"), 1, object("one"), &held("a"));
        without.handle_doubled(object("map"), 2, object("two"), &object("one"));
        let text = without.text().unwrap();
        assert!(text.starts_with("one goes without the name map: map is claimed by a, "), "{text}");
        assert!(text.contains("; two goes without the name map: one of this node"), "{text}");

        without.handle_end(&object("map"), 1);
        assert!(without.text().unwrap().starts_with("two goes"));
        without.handle_end(&object("other"), 2);
        without.handle_end(&object("map"), 2);
        assert_eq!(without.text(), None);
    }

    #[test]
    fn it_is_said_who_holds_the_name_now() {
        let mut without = UnmetClaims::default();
        without.handle_refused(object("map"), 1, object("one"), &held("a"));
        without.handle_refused(
            object("map"),
            2,
            object("two"),
            &ClaimRefused::TooMany { limit: 1 },
        );

        without.handle_holder(&object("map"), None);
        assert!(without.text().unwrap().contains("it has no holder now: restart one, or"));
        let node = NodeName::new("b").unwrap();
        let holder = Holder { node, object: object("map"), epoch: 9 };
        without.handle_holder(&object("map"), Some(&holder));
        without.handle_holder(&object("maps"), None);

        let text = without.text().unwrap();
        assert!(
            text.contains("one goes without the name map: map is claimed by b:map, under epoch 9")
        );
        assert!(text.contains("two goes without the name map: this node claims 1 names"), "{text}");
    }

    #[test]
    fn of_many_the_first_are_named() {
        let mut without = UnmetClaims::default();
        (0..100).for_each(|n| without.handle_refused(object("map"), n, object("one"), &held("a")));
        assert!(without.text().unwrap().ends_with("; and 92 more"));
    }
}
