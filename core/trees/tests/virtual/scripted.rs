//! Leaves that answer as a test writes down, and note how they are called.

use blastema_trees::{Factory, Halt, Leaf, LeafContext, LeafKind, LeafResult, Status, Tree};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// The status of a letter.
pub(crate) fn status(letter: char) -> Status {
    match letter {
        'S' => Status::Success,
        'F' => Status::Failure,
        'R' => Status::Running,
        'K' => Status::Skipped,
        _ => Status::Idle,
    }
}

/// The letter of a status.
pub(crate) fn letter(status: Status) -> char {
    match status {
        Status::Success => 'S',
        Status::Failure => 'F',
        Status::Running => 'R',
        Status::Skipped => 'K',
        Status::Idle => 'I',
    }
}

/// The answers of a leaf, one for each call; the last one stays, or all begin again.
#[derive(Clone)]
pub(crate) struct Answers {
    pub(crate) kind: LeafKind,
    pub(crate) letters: String,
    pub(crate) again: bool,
}

/// What the leaves of a tree have been called for: `path:start:S`, `path:halt`.
#[derive(Clone, Default)]
pub(crate) struct Calls(Arc<Mutex<Vec<String>>>);

impl Calls {
    pub(crate) fn note(&self, call: String) {
        self.0.lock().unwrap().push(call);
    }

    pub(crate) fn take(&self) -> Vec<String> {
        std::mem::take(&mut self.0.lock().unwrap())
    }
}

/// A leaf that answers as it is told. `P` panics.
struct Scripted {
    answers: Answers,
    position: usize,
    calls: Calls,
}

impl Scripted {
    fn step(&mut self, cx: &LeafContext<'_>, what: &str) -> LeafResult {
        let letters: Vec<char> = self.answers.letters.chars().collect();
        let index = if self.answers.again {
            self.position % letters.len()
        } else {
            self.position.min(letters.len() - 1)
        };
        self.position += 1;
        let letter = letters[index];
        self.calls.note(format!("{}:{what}:{letter}", cx.path()));
        match letter {
            'X' => Err("the leaf's own".into()),
            'P' => panic!("the leaf's own"),
            letter => Ok(status(letter)),
        }
    }
}

impl Leaf for Scripted {
    fn start(&mut self, cx: &mut LeafContext<'_>) -> LeafResult {
        self.step(cx, if self.answers.kind == LeafKind::Action { "start" } else { "tick" })
    }

    fn running(&mut self, cx: &mut LeafContext<'_>) -> LeafResult {
        self.step(cx, "run")
    }

    fn halt(&mut self, cx: &mut LeafContext<'_>) -> Halt {
        self.calls.note(format!("{}:halt", cx.path()));
        Halt::Done
    }
}

/// Registers scripted leaves.
pub(crate) fn register(factory: &mut Factory, leaves: &BTreeMap<String, Answers>, calls: &Calls) {
    for (name, answers) in leaves {
        let make = {
            let (answers, calls) = (answers.clone(), calls.clone());
            move || Scripted { answers: answers.clone(), position: 0, calls: calls.clone() }
        };
        match answers.kind {
            LeafKind::Action => factory.leaf(name, make),
            kind => {
                // A function keeps nothing; one leaf behind a lock does.
                let leaves: Mutex<BTreeMap<String, Scripted>> = Mutex::default();
                let function = move |cx: &mut LeafContext<'_>| {
                    let mut leaves = leaves.lock().unwrap();
                    let path = cx.path().to_owned();
                    leaves.entry(path).or_insert_with(&make).start(cx)
                };
                match kind {
                    LeafKind::Condition => factory.condition(name, [], function),
                    _ => factory.action(name, [], function),
                }
            }
        }
    }
}

/// A tree under test, of scripted leaves: names that begin with `C` are conditions, with `Y`
/// actions that are done at once, and all others actions.
pub(crate) struct Bench {
    pub(crate) tree: Tree,
    pub(crate) calls: Calls,
    pub(crate) now: Duration,
}

/// The file around one tree, whose outermost node is `body`.
pub(crate) fn file(body: &str) -> String {
    format!(r#"<root BTCPP_format="4"><BehaviorTree ID="Main">{body}</BehaviorTree></root>"#)
}

/// A factory of scripted leaves, given as `"C=SF A=RRS"`.
pub(crate) fn factory(leaves: &str) -> (Factory, Calls) {
    let answers = leaves.split_whitespace().map(|leaf| {
        let (name, letters) = leaf.split_once('=').unwrap();
        let kind = match name.chars().next().unwrap() {
            'C' => LeafKind::Condition,
            'Y' => LeafKind::SyncAction,
            _ => LeafKind::Action,
        };
        let letters = letters.to_owned();
        (name.to_owned(), Answers { kind, letters, again: false })
    });
    let (mut factory, calls) = (Factory::new(), Calls::default());
    register(&mut factory, &answers.collect(), &calls);
    (factory, calls)
}

impl Bench {
    /// The tree of these leaves and of this outermost node.
    #[track_caller]
    pub(crate) fn new(leaves: &str, body: &str) -> Bench {
        let (factory, calls) = factory(leaves);
        let tree = factory.load("test.xml", &file(body)).unwrap();
        Bench { tree, calls, now: Duration::ZERO }
    }

    /// Ticks once at the present time, and gives the letter of the answer, or `!` for an error.
    pub(crate) fn tick(&mut self) -> char {
        self.tree.tick(self.now).map_or('!', letter)
    }

    /// The answers of so many ticks.
    pub(crate) fn ticks(&mut self, count: usize) -> String {
        (0..count).map(|_| self.tick()).collect()
    }

    /// Ticks so many milliseconds later.
    pub(crate) fn after(&mut self, msec: u64) -> char {
        self.now += Duration::from_millis(msec);
        self.tick()
    }

    /// The calls since the last time, without the numbers of nodes.
    pub(crate) fn calls(&self) -> String {
        let calls = self.calls.take();
        let short = |call: &String| {
            let parts = call.split(':').filter(|part| !part.chars().all(|c| c.is_ascii_digit()));
            parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join(":")
        };
        calls.iter().map(short).collect::<Vec<_>>().join(" ")
    }
}
