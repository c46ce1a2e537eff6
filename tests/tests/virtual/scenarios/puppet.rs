//! A component that does what the test says: strings are pulled for its hooks, requests tell it the
//! rest.

use blastema::prelude::*;
use blastema::{Down, RequestError};
use blastema_testkit::TestNode;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What a hook does the next time that it is called.
#[derive(Clone, Debug)]
pub(crate) enum Pull {
    Fail(&'static str),
    Fatal(&'static str),
    /// What it needs is not there yet.
    Unavailable(&'static str),
    Panic(&'static str),
    /// It does not return for so long.
    Wait(Duration),
    /// It does not return before this line is in the diary.
    WaitFor(&'static str),
    /// It keeps its thread until the puppets are released.
    Block,
    /// It watches this object.
    Watch(&'static str),
}

/// What a puppet is asked to do, while it serves the request or afterwards.
#[derive(Clone, Debug, PartialEq, Structure)]
pub(crate) enum Deed {
    /// Nothing but to answer.
    Nothing,
    /// Panics with this text.
    Panic(String),
    /// Panics in a task of its own, a little later.
    PanicInTask(String),
    /// Panics in a timer, a little later.
    PanicInTimer(String),
    /// Panics with something that is no text.
    PanicOddly,
    /// Leaves work because of this.
    Fail(String),
    /// Leaves work for ever because of this.
    FailFatally(String),
    /// Ends this incarnation in order.
    Stop,
    /// Takes so many milliseconds, without keeping the thread.
    Await(u64),
    /// The same, and says so before.
    AwaitAsAnnounced(u64),
    /// Keeps the thread until the test releases it; then it publishes and sends a note to this
    /// puppet.
    Block(String),
    /// Declares a fault of this code.
    Declare(String),
    /// Finds a value out of range.
    Check(f64),
    /// Watches another object.
    Watch(String),
    /// Publishes this number.
    Publish(u32),
    /// Publishes this, a little later.
    PublishSoon(u32),
    /// Asks another puppet to do nothing.
    Consult(String),
}

/// Asks a puppet for a deed. It answers with its incarnation.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "test/do", reply = u64)]
pub(crate) struct Do(pub(crate) Deed);

/// A command that is noted in the diary.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "test/note")]
pub(crate) struct Note(pub(crate) u32);

/// What puppets publish and listen to; odd ones only.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "test/news")]
pub(crate) struct News(pub(crate) u32);

/// The test's end of all strings, and what the puppets wrote down.
#[derive(Clone, Default)]
pub(crate) struct Strings(Arc<(Mutex<Inner>, Condvar)>);

#[derive(Default)]
struct Inner {
    /// Those who block may go on.
    released: bool,
    pulls: BTreeMap<String, VecDeque<Pull>>,
    diary: Vec<String>,
}

impl Strings {
    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A node with a puppet of each of these names.
    pub(crate) async fn robot<const N: usize>(names: [&'static str; N]) -> (Self, TestNode) {
        let strings = Strings::default();
        let builder = Node::builder("module1");
        let builder = names.iter().fold(builder, |node, name| node.child(strings.spec(name)));
        let node = TestNode::start(builder).await;
        (strings, node)
    }

    /// A puppet of this name.
    pub(crate) fn spec(&self, name: &'static str) -> ChildSpec<Puppet> {
        let strings = self.clone();
        ChildSpec::new(name, move || {
            strings.act_at_once(name, "factory");
            Puppet { name, strings: strings.clone() }
        })
    }

    /// The next time that `hook` of the puppet `name` is called, it does this; pulled twice, the
    /// time after that too.
    pub(crate) fn pull(&self, name: &str, hook: &str, pull: Pull) {
        self.inner().pulls.entry(format!("{name} {hook}")).or_default().push_back(pull);
    }

    /// Whatever was pulled and not yet done is not going to be done.
    pub(crate) fn cut_all(&self) {
        self.inner().pulls.clear();
    }

    /// What was written down since the last look, but for the rounds.
    pub(crate) fn diary(&self) -> Vec<String> {
        std::mem::take(&mut self.inner().diary)
    }

    /// The lines of the diary that hold this text.
    pub(crate) fn lines(&self, text: &str) -> Vec<String> {
        self.diary().into_iter().filter(|line| line.contains(text)).collect()
    }

    /// The first hooks of incarnations since the last look, and the last ones.
    pub(crate) fn begins_and_ends(&self) -> Vec<String> {
        let short = |line: String| {
            line.strip_suffix(" on_initialize")
                .map(|who| format!("+{who}"))
                .or_else(|| line.strip_suffix(" on_finalize").map(|who| format!("-{who}")))
        };
        self.diary().into_iter().filter_map(short).collect()
    }

    /// Keeps the thread, as a driver does that waits for a device.
    pub(crate) fn block(&self) {
        let mut inner = self.inner();
        while !inner.released {
            inner = self.0.1.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Lets all go that block.
    pub(crate) fn release(&self) {
        self.inner().released = true;
        self.0.1.notify_all();
    }

    pub(crate) fn write(&self, line: String) {
        self.inner().diary.push(line);
    }

    fn next(&self, name: &str, hook: &str) -> Option<Pull> {
        self.inner().pulls.get_mut(&format!("{name} {hook}"))?.pop_front()
    }

    fn act_at_once(&self, name: &str, hook: &str) {
        match self.next(name, hook) {
            Some(Pull::Panic(text)) => panic!("{text}"),
            Some(Pull::Block) => self.block(),
            _ => {}
        }
    }
}

pub(crate) struct Puppet {
    name: &'static str,
    strings: Strings,
}

impl Puppet {
    async fn act(&self, hook: &'static str, cx: &mut Context<Self>) -> Result<(), Failure> {
        let Puppet { name, strings } = self;
        if hook != "on_execute" {
            strings.write(format!("{name}{} {hook}", cx.incarnation()));
        }
        match strings.next(name, hook) {
            None => Ok(()),
            Some(Pull::Fail(why)) => Err(why.into()),
            Some(Pull::Fatal(why)) => Err(Failure::fatal(why)),
            Some(Pull::Unavailable(why)) => Err(Failure::unavailable(why)),
            Some(Pull::Panic(text)) => panic!("{text}"),
            Some(Pull::Wait(span)) => {
                tokio::time::sleep(span).await;
                Ok(())
            }
            Some(Pull::Block) => {
                strings.block();
                Ok(())
            }
            Some(Pull::Watch(name)) => cx.watch(name).map_err(|error| error.to_string().into()),
            Some(Pull::WaitFor(line)) => {
                while !strings.inner().diary.iter().any(|written| written == line) {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
                Ok(())
            }
        }
    }
}

impl Drop for Puppet {
    fn drop(&mut self) {
        self.strings.act_at_once(self.name, "drop");
    }
}

impl Component for Puppet {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Do>();
        ports.accept::<Note>();
        ports.listen::<News>().only_if(|News(n)| {
            assert!(*n != 13, "thirteen is an unlucky number");
            n % 2 == 1
        });
    }

    blastema_tests::hooks! {
        on_initialize on_startup on_activated on_execute on_deactivated on_aborting on_error
        on_reset on_shutdown on_finalize
    }
}

impl Handle<Do> for Puppet {
    async fn handle(&mut self, Do(deed): Do, cx: &mut Context<Self>) -> u64 {
        let soon = Duration::from_millis(10);
        match deed {
            Deed::Nothing => {}
            Deed::Panic(text) => panic!("{text}"),
            Deed::PanicInTask(text) => cx.spawn(async move {
                tokio::time::sleep(soon).await;
                panic!("{text}");
            }),
            Deed::PanicInTimer(text) => {
                cx.after(soon, move |_, _| panic!("{text}"));
            }
            Deed::PanicOddly => std::panic::panic_any(42_u8),
            Deed::Fail(why) => cx.fail(why),
            Deed::FailFatally(why) => cx.fail(Failure::fatal(why)),
            Deed::Stop => cx.stop(),
            Deed::Await(ms) => tokio::time::sleep(Duration::from_millis(ms)).await,
            Deed::AwaitAsAnnounced(ms) => {
                let _announced = cx.long_operation(Duration::from_millis(2 * ms));
                tokio::time::sleep(Duration::from_millis(ms)).await;
            }
            Deed::Block(ear) => {
                self.strings.block();
                cx.publish(News(99));
                if let Ok(ear) = cx.sender::<Note>(&ear) {
                    let _ = ear.tell(Note(99));
                }
            }
            Deed::Declare(code) => {
                cx.declare_fault(FaultKind::Custom(code.as_str().into()), "as it was told");
            }
            Deed::Check(value) => {
                cx.check_range("the value", &value, 0.0..=1.0);
            }
            Deed::Watch(name) => cx.watch(&name).expect("a good name"),
            Deed::Publish(n) => cx.publish(News(n)),
            Deed::PublishSoon(n) => {
                cx.after(soon, move |_, cx| cx.publish(News(n)));
            }
            Deed::Consult(name) => {
                let other = cx.sender::<Do>(&name).expect("a puppet of this name");
                let _ = other.ask(Do(Deed::Nothing)).await;
            }
        }
        cx.incarnation().0
    }
}

impl Handle<Note> for Puppet {
    async fn handle(&mut self, Note(n): Note, cx: &mut Context<Self>) {
        self.strings.write(format!("{}{} note {n}", self.name, cx.incarnation()));
    }
}

impl Handle<News> for Puppet {
    async fn handle(&mut self, News(n): News, cx: &mut Context<Self>) {
        self.strings.write(format!("{}{} news {n}", self.name, cx.incarnation()));
    }
}

impl Handle<Down> for Puppet {
    async fn handle(&mut self, down: Down, cx: &mut Context<Self>) {
        let Down { object, node, incarnation, ending } = down;
        let (me, own) = (self.name, cx.incarnation());
        let node = node.map(|node| format!("{node}:")).unwrap_or_default();
        self.strings.write(format!("{me}{own} watched {node}{object}{incarnation}: {ending:?}"));
    }
}

/// Asks for a deed, and says which incarnation did it.
pub(crate) async fn ask(node: &Node, name: &str, deed: Deed) -> Result<u64, RequestError<Do>> {
    node.sender::<Do>(name).expect("a puppet of this name").ask(Do(deed)).await
}

/// Which incarnation of the puppet answers now.
pub(crate) async fn incarnation(node: &Node, name: &str) -> u64 {
    ask(node, name, Deed::Nothing).await.expect("the puppet answers")
}

/// Lets the puppet panic in a handler.
pub(crate) async fn strike(node: &Node, name: &str) {
    let struck = ask(node, name, Deed::Panic("struck".into())).await;
    assert!(matches!(struck.expect_err("it dies").kind, DeliveryError::PeerDied { .. }));
}
