//! Which objects of a node cannot do without which others.
//!
//! What an object suffers while something that it needs is down is taken for a symptom. Of two
//! objects that need each other each would be the symptom of the other, and neither the root: such
//! a circle is refused before anything starts.

use crate::sorted::SortedMap;
use crate::suggestion::nearest;
use crate::{NameError, NodeName, ObjectName};
use std::collections::BTreeSet;

/// Why the dependencies of a node cannot be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DependencyError {
    /// An object depends on what this node does not have.
    #[error(
        "{name} depends on {needed:?}, which is no object of this node ({}): correct the name, or add it before",
        hint(nearest.as_deref(), &known.0, known.1)
    )]
    Unknown {
        /// The object that declares the dependency.
        name: ObjectName,
        /// What it is said to depend on.
        needed: String,
        /// What may have been meant.
        nearest: Option<String>,
        /// The node's other objects, in order of their names; at most ten, and how many more there
        /// are.
        known: (Vec<ObjectName>, usize),
    },
    /// A dependency of an object is not a valid name.
    #[error("what {name} depends on: {error}")]
    Name {
        /// The object that declares the dependency.
        name: ObjectName,
        /// What is wrong with the name.
        error: NameError,
    },
    /// An object that is to be removed is needed by one that stays.
    #[error("{by} depends on {name}: remove {by} first")]
    Needed {
        /// The object that is needed.
        name: ObjectName,
        /// The object that depends on it.
        by: ObjectName,
    },
    /// Objects depend on each other, or one on itself.
    #[error("{}: each waits for the next, so leave out one of these dependencies", shown(way))]
    Circle {
        /// The way from one of them to itself: the first is also the last.
        way: Vec<ObjectName>,
    },
}

/// So many objects are named to a user who named none of them.
const KNOWN_MAX: usize = 10;

fn hint(nearest: Option<&str>, known: &[ObjectName], more: usize) -> String {
    let known = known.iter().map(ObjectName::as_str).collect::<Vec<_>>().join(", ");
    match (nearest, known.is_empty(), more) {
        (Some(word), ..) => format!("did you mean {word:?}?"),
        (None, true, _) => "which has no other".to_owned(),
        (None, false, 0) => format!("which has {known}"),
        (None, false, more) => format!("which has {known}, and {more} more"),
    }
}

fn shown(way: &[ObjectName]) -> String {
    let names: Vec<&str> = way.iter().map(ObjectName::as_str).collect();
    format!("{} depends on itself, {}", names.first().unwrap_or(&"it"), names.join(" -> "))
}

/// The dependencies of a node's objects.
///
/// ```
/// use blastema_core::detection::dependencies::Dependencies;
///
/// let mut objects = Dependencies::of("module1".parse()?);
/// objects.enter("laser".parse()?, &[]);
/// objects.enter("planner".parse()?, &["laser".to_owned(), "module2:map".to_owned()]);
/// assert_eq!(objects.check(), Ok(()));
///
/// objects.enter("laser".parse()?, &["planner".to_owned()]);
/// let error = objects.check().unwrap_err().to_string();
/// assert!(error.starts_with("laser depends on itself, laser -> planner -> laser"));
/// # Ok::<(), blastema_core::NameError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Dependencies {
    node: NodeName,
    /// As many as the node has objects. What incarnations on other nodes is left out.
    needs: SortedMap<ObjectName, Box<[String]>>,
}

impl Dependencies {
    /// Those of a node that has no object yet.
    pub fn of(node: NodeName) -> Self {
        Dependencies { node, needs: SortedMap::new() }
    }

    /// The node has an object that needs these, here (`laser`, `module1:laser`) or elsewhere
    /// (`module2:laser`), of which nothing can be known here.
    pub fn enter(&mut self, object: ObjectName, needs: &[String]) {
        let own = |needed: &String| match needed.split_once(':') {
            Some((node, own)) => (node == self.node.as_str()).then(|| own.to_owned()),
            None => Some(needed.clone()),
        };
        let needs = needs.iter().filter_map(own).collect();
        self.needs.insert(object, needs);
    }

    /// Enters objects while the node runs, unless their dependencies cannot be.
    ///
    /// # Errors
    /// What is wrong; none of the objects is entered then.
    pub fn add<'a>(
        &mut self,
        objects: impl IntoIterator<Item = (&'a ObjectName, &'a [String])>,
    ) -> Result<(), DependencyError> {
        let mut with = self.clone();
        let enter = |(object, needs): (&'a ObjectName, &[String])| {
            with.enter(object.clone(), needs);
            object
        };
        let entered: Vec<&ObjectName> = objects.into_iter().map(enter).collect();
        entered.into_iter().try_for_each(|object| with.check_known(object))?;
        with.check_circles()?;
        *self = with;
        Ok(())
    }

    /// Whether the node has the object.
    pub fn has(&self, object: &ObjectName) -> bool {
        self.needs.contains_key(object)
    }

    /// The node has these objects no more.
    ///
    /// # Errors
    /// Another object of the node needs one of them; all stay then.
    pub fn remove(&mut self, objects: &[ObjectName]) -> Result<(), DependencyError> {
        let removed: BTreeSet<&str> = objects.iter().map(ObjectName::as_str).collect();
        let others = self.needs.iter().filter(|(by, _)| !removed.contains(by.as_str()));
        let needed = others.flat_map(|(by, needs)| needs.iter().map(move |needed| (by, needed)));
        let gone = |(_, needed): &(_, &String)| removed.contains(needed.as_str());
        if let Some((by, needed)) = { needed }.find(gone) {
            let name = objects.iter().find(|name| name.as_str() == needed);
            let name = name.expect("it is one of them").clone();
            return Err(DependencyError::Needed { name, by: by.clone() });
        }
        self.forget(objects);
        Ok(())
    }

    /// These objects did not come to be.
    pub fn forget(&mut self, objects: &[ObjectName]) {
        objects.iter().for_each(|object| drop(self.needs.remove(object)));
    }

    /// Everything that is needed is there, and nothing needs itself.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn check(&self) -> Result<(), DependencyError> {
        self.needs.keys().try_for_each(|object| self.check_known(object))?;
        self.check_circles()
    }

    fn check_known(&self, object: &ObjectName) -> Result<(), DependencyError> {
        let missing = |needed: &&String| !self.needs.contains_key(needed.as_str());
        let Some(needed) = self.needs[object].iter().find(missing) else { return Ok(()) };
        if let Err(error) = ObjectName::new(needed) {
            return Err(DependencyError::Name { name: object.clone(), error });
        }
        let others = self.needs.keys().filter(|other| *other != object);
        let nearest = nearest(needed, others.clone().map(ObjectName::as_str)).map(str::to_owned);
        let first: Vec<ObjectName> = others.clone().take(KNOWN_MAX).cloned().collect();
        let known = (first, others.count().saturating_sub(KNOWN_MAX));
        let (name, needed) = (object.clone(), needed.clone());
        Err(DependencyError::Unknown { name, needed, nearest, known })
    }

    fn check_circles(&self) -> Result<(), DependencyError> {
        let known = |needed: &String| Some(self.needs.get_key_value(needed.as_str())?.0);
        let needs = self.needs.iter();
        let needs = needs.map(|(object, needs)| (object, needs.iter().filter_map(known).collect()));
        match circle(&needs.collect()) {
            Some(way) => Err(DependencyError::Circle { way }),
            None => Ok(()),
        }
    }
}

/// A path that leads from an object back to itself, where there is one: the first is also the last.
/// An object that is needed and needs no other may be left out of the map.
///
/// ```
/// use blastema_core::ObjectName;
/// use blastema_core::detection::dependencies::circle;
///
/// let [a, b] = [ObjectName::new("a")?, ObjectName::new("b")?];
/// assert_eq!(circle(&[(&a, vec![&b])].into()), None);
/// assert_eq!(circle(&[(&a, vec![&b]), (&b, vec![&a])].into()), Some(vec![a.clone(), b.clone(), a]));
/// # Ok::<(), blastema_core::NameError>(())
/// ```
pub fn circle<T: Ord + Clone>(needs: &SortedMap<&T, Vec<&T>>) -> Option<Vec<T>> {
    let needs_of = |name: &T| needs.get(name).map_or(&[][..], Vec::as_slice).iter();
    // Every object that was visited, and whether it is still on the path.
    let mut met = SortedMap::new();
    for start in needs.keys().copied() {
        // The way so far, each with what is still to be looked at. No recursion: a chain may be
        // long.
        let mut way = Vec::new();
        let mut next = Some(start);
        while next.is_some() || !way.is_empty() {
            if let Some(name) = next {
                match met.get(name) {
                    Some(true) => {
                        let way = way.iter().map(|(name, _)| *name).skip_while(|met| *met != name);
                        return Some(way.chain([name]).cloned().collect());
                    }
                    Some(false) => {}
                    None => {
                        met.insert(name, true);
                        way.push((name, needs_of(name)));
                    }
                }
            }
            next = way.last_mut().and_then(|(_, open)| open.next().copied());
            if next.is_none() {
                met.extend(way.pop().map(|(settled, _)| (settled, false)));
            }
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::object as name;

    fn objects(needs: &[(&str, &[&str])]) -> Dependencies {
        let mut objects = Dependencies::of(NodeName::new("m").expect("a good name"));
        for (object, needs) in needs {
            let needs: Vec<String> = needs.iter().map(|need| (*need).to_owned()).collect();
            objects.enter(name(object), &needs);
        }
        objects
    }

    fn check(needs: &[(&str, &[&str])], reported: &str) {
        let text =
            objects(needs).check().map_or_else(|error| error.to_string(), |()| "fine".into());
        assert!(text.contains(reported), "{text}");
    }

    #[test]
    fn a_circle_is_shown_from_one_of_its_members_back_to_it() {
        check(&[("a", &["b"]), ("b", &["c"]), ("c", &["a"])], "a -> b -> c -> a: ");
        check(&[("a", &["b"]), ("b", &["c"]), ("c", &["b"])], "b depends on itself, b -> c -> b: ");
        check(&[("a", &["a"])], "a -> a: ");
        check(&[("a", &["m:b"]), ("b", &["m:a"])], "a -> b -> a: ");
    }

    #[test]
    fn whatever_is_no_circle_is_fine() {
        check(&[], "fine");
        check(&[("a", &["b", "c", "b"]), ("b", &["d"]), ("c", &["d"]), ("d", &[])], "fine");
        check(&[("a", &["other:a"]), ("b", &["other:whatever"])], "fine");
    }

    #[test]
    fn a_name_that_nobody_has_is_told_with_the_nearest() {
        check(&[("laser", &[]), ("planner", &["lasr"])], "(did you mean \"laser\"?)");
        check(&[("laser", &[]), ("planner", &["m:lasr"])], "(did you mean \"laser\"?)");
    }

    #[test]
    fn a_name_that_is_like_none_is_told_with_those_that_there_are() {
        check(&[("lasr", &["laser"])], "no object of this node (which has no other): correct");
        check(
            &[("laser", &[]), ("map", &[]), ("planner", &["b"])],
            "(which has laser, map): correct",
        );
        let lamps: Vec<String> = (0..30).map(|n| format!("lamp/{n:02}")).collect();
        let lamps = lamps.iter().map(|lamp| (lamp.as_str(), &[][..]));
        let all: Vec<_> = lamps.chain([("planner", &["b"][..])]).collect();
        check(&all, "lamp/08, lamp/09, and 20 more)");
    }

    #[test]
    fn a_chain_of_any_length_is_walked() {
        let names: Vec<ObjectName> = (0..20_000).map(|at| name(&at.to_string())).collect();
        let mut needs: SortedMap<_, _> =
            names.windows(2).map(|pair| (&pair[0], vec![&pair[1]])).collect();
        assert_eq!(circle(&needs), None);

        needs.insert(&names[19_999], vec![&names[0]]);
        assert_eq!(circle(&needs).map(|way| way.len()), Some(20_001));
    }

    #[test]
    fn what_is_added_later_closes_no_circle_and_leaves_no_trace_where_it_would() {
        let mut running = objects(&[("a", &["b"]), ("b", &[])]);
        let names = ["a", "b", "c", "d"].map(name);
        let [a, b, c, d] = &names;
        let on = |needed: &str| vec![needed.to_owned()];

        let circle = [(c, &*on("d")), (d, &*on("c"))];
        let refused = running.add(circle).expect_err("each needs the other");
        assert!(matches!(refused, DependencyError::Circle { .. }), "{refused}");
        assert!(running.add([(d, &*on("c"))]).is_err(), "c was not entered");
        assert_eq!(running.add([(c, &*on("d")), (d, &*on("b"))]), Ok(()));
        let needed = running.remove(&[b.clone(), c.clone()]).expect_err("a and d stay");
        assert_eq!(needed.to_string(), "a depends on b: remove a first");
        assert!(running.has(c), "all stay");
        assert_eq!(running.remove(&[a.clone(), b.clone(), d.clone(), c.clone()]), Ok(()));
        assert!(!names.iter().any(|name| running.has(name)));
    }
}
