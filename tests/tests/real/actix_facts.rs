//! What this product knows about actix 0.13.5, run as tests.
//!
//! The design rests on these facts, the pleasant and the unpleasant ones. Where one of them changes
//! with a new version, the test that names it fails, and shows which part of the design to look at
//! again: ARCHITECTURE.md says where it is used.

use actix::dev::ContextFut;
use actix::prelude::*;
use std::cell::{Cell, RefCell};
use std::future::poll_fn;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::{Pin, pin};
use std::rc::Rc;
use std::sync::mpsc;
use std::task::Poll;
use std::time::Duration;
use tokio::task::yield_now;

/// Runs a test on an arbiter of its own.
fn run(test: impl Future<Output = ()>) {
    System::new().block_on(test);
}

/// The same, under a clock that only the test moves.
fn run_paused(test: impl Future<Output = ()>) {
    let runtime = || {
        let mut builder = tokio::runtime::Builder::new_current_thread();
        builder.enable_all().start_paused(true).build().expect("a runtime can be built")
    };
    System::with_tokio_rt(runtime).block_on(test);
}

/// Lets everything that is ready on this arbiter run.
async fn settle() {
    for _ in 0..10 {
        yield_now().await;
    }
}

/// An actor that does what it is told and writes down what happens to it.
#[derive(Default)]
struct Subject {
    sum: u32,
    log: Rc<RefCell<Vec<&'static str>>>,
}

impl Subject {
    fn with_log() -> (Subject, Rc<RefCell<Vec<&'static str>>>) {
        let log = Rc::default();
        (Subject { sum: 0, log: Rc::clone(&log) }, log)
    }
}

impl Actor for Subject {
    type Context = Context<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        self.log.borrow_mut().push("started");
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        let unwinding = std::thread::panicking();
        self.log.borrow_mut().push(if unwinding { "stopped while unwinding" } else { "stopped" });
    }
}

impl Supervised for Subject {
    fn restarting(&mut self, _: &mut Self::Context) {
        self.log.borrow_mut().push("restarting");
    }
}

/// Adds one and says how much there is.
#[derive(Message)]
#[rtype(result = "u32")]
struct Add;

impl Handler<Add> for Subject {
    type Result = u32;

    fn handle(&mut self, Add: Add, _: &mut Self::Context) -> u32 {
        self.sum += 1;
        self.sum
    }
}

/// Panics, or stops the actor in order.
#[derive(Message)]
#[rtype(result = "()")]
enum End {
    Panic,
    Stop,
}

impl Handler<End> for Subject {
    type Result = ();

    fn handle(&mut self, end: End, context: &mut Self::Context) {
        match end {
            End::Panic => panic!("told to"),
            End::Stop => context.stop(),
        }
    }
}

type Action = dyn FnOnce(&mut Subject, &mut Context<Subject>) + Send;

/// Runs this on the actor.
#[derive(Message)]
#[rtype(result = "()")]
struct Run(Box<Action>);

impl Handler<Run> for Subject {
    type Result = ();

    fn handle(&mut self, Run(action): Run, context: &mut Self::Context) {
        action(self, context);
    }
}

#[test]
fn a_supervised_actor_does_not_survive_a_panic() {
    let _turn = blastema_doubles::turn();
    run(async {
        let subject = Supervisor::start(|_| Subject::default());

        subject.do_send(End::Panic);
        settle().await;

        assert!(!subject.connected());
        assert_eq!(subject.send(Add).await, Err(MailboxError::Closed));
    });
}

#[test]
fn a_supervisor_restarts_the_same_value_with_its_mailbox_after_an_orderly_stop() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let subject = Supervisor::start(|_| subject);

        subject.do_send(Add);
        subject.do_send(End::Stop);
        let left_in_the_mailbox = subject.send(Add);

        assert_eq!(left_in_the_mailbox.await, Ok(2), "the sum was not reset");
        assert_eq!(*log.borrow(), ["started", "stopped", "restarting", "started"]);
    });
}

#[test]
fn the_death_of_an_actor_tells_its_callers_nothing_but_that_it_is_closed() {
    let _turn = blastema_doubles::turn();
    run(async {
        let subject = Subject::default().start();

        let in_service = subject.send(End::Panic);
        let queued = subject.send(Add);

        assert_eq!(in_service.await, Err(MailboxError::Closed));
        assert_eq!(queued.await, Err(MailboxError::Closed));
    });
}

#[test]
fn stopped_runs_while_the_panic_unwinds() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let subject = subject.start();

        subject.do_send(End::Panic);
        settle().await;

        assert_eq!(*log.borrow(), ["started", "stopped while unwinding"]);
    });
}

#[test]
fn a_second_panic_in_stopped_aborts_the_process() {
    let _turn = blastema_doubles::turn();
    struct Twice;
    impl Actor for Twice {
        type Context = Context<Self>;
        fn stopped(&mut self, _: &mut Self::Context) {
            panic!("and again");
        }
    }
    impl Handler<End> for Twice {
        type Result = ();
        fn handle(&mut self, _: End, _: &mut Self::Context) {
            panic!("once");
        }
    }
    // The deed needs a process of its own: this test program, which runs only this test.
    const IN_CHILD: &str = "BLASTEMA_SECOND_PANIC";
    if std::env::var_os(IN_CHILD).is_some() {
        run(async {
            let twice = Twice.start();
            twice.do_send(End::Panic);
            settle().await;
        });
        return;
    }

    let program = std::env::current_exe().expect("a running test has a program");
    let child = std::process::Command::new(program)
        .args(["--exact", "actix_facts::a_second_panic_in_stopped_aborts_the_process"])
        .env(IN_CHILD, "yes")
        .output()
        .expect("the test program can be started");

    use std::os::unix::process::ExitStatusExt;
    assert_eq!(child.status.signal(), Some(6), "SIGABRT, not {:?}", child.status);
}

#[test]
fn do_send_ignores_the_capacity_of_the_mailbox() {
    let _turn = blastema_doubles::turn();
    run(async {
        let subject = Subject::default().start();

        // The default capacity is 16; nothing is served before this test awaits.
        for _ in 0..1_000 {
            subject.do_send(Add);
        }

        assert_eq!(subject.send(Add).await, Ok(1_001));
    });
}

#[test]
fn send_ignores_the_capacity_of_the_mailbox() {
    let _turn = blastema_doubles::turn();
    run(async {
        let subject = Subject::default().start();

        let mut requests: Vec<_> = (0..1_000).map(|_| Box::pin(subject.send(Add))).collect();
        // Every request is polled once and so put into the mailbox before any is served.
        poll_fn(|cx| {
            for request in &mut requests {
                assert!(request.as_mut().poll(cx).is_pending());
            }
            Poll::Ready(())
        })
        .await;

        assert_eq!(requests.pop().expect("there are a thousand").await, Ok(1_000));
    });
}

#[test]
fn try_send_counts_for_each_clone_of_the_address() {
    let _turn = blastema_doubles::turn();
    run(async {
        let subject = Subject::default().start();

        let by_one_handle = (0..100).take_while(|_| subject.try_send(Add).is_ok()).count();
        let by_fresh_clones =
            (0..100).take_while(|_| subject.clone().try_send(Add).is_ok()).count();

        assert!(by_one_handle <= 17, "{by_one_handle}");
        assert_eq!(by_fresh_clones, 100);
    });
}

#[test]
fn a_hung_actor_counts_as_connected_and_its_arbiter_as_alive() {
    let _turn = blastema_doubles::turn();
    run(async {
        let arbiter = Arbiter::new();
        let subject = Subject::start_in_arbiter(&arbiter.handle(), |_| Subject::default());
        let (entered, has_entered) = mpsc::channel();
        let (release, released) = mpsc::channel::<()>();
        subject.do_send(Run(Box::new(move |_, _| {
            entered.send(()).expect("the test waits");
            // The sender's end is dropped, or something is sent: either ends the hang.
            released.recv().ok();
        })));
        has_entered.recv().expect("the handler runs");

        assert!(subject.connected());
        assert!(arbiter.alive());
        assert!(arbiter.stop(), "stopping is accepted, and comes to nothing while it hangs");
        assert!(subject.connected());
        let successor = Arbiter::new();
        let other = Subject::start_in_arbiter(&successor.handle(), |_| Subject::default());
        assert_eq!(other.send(Add).await, Ok(1), "another arbiter works beside the hung one");

        drop(release);
        successor.stop();
        assert!(arbiter.join().is_ok());
        assert!(successor.join().is_ok());
    });
}

#[test]
fn a_mailbox_is_drained_without_ever_yielding() {
    let _turn = blastema_doubles::turn();
    /// Far more than tokio's budget for one turn of a task, which is 128.
    const ROUNDS: u32 = 10_000;
    struct Whirl(Rc<Cell<u32>>);
    impl Actor for Whirl {
        type Context = Context<Self>;
    }
    impl Handler<Add> for Whirl {
        type Result = u32;
        fn handle(&mut self, Add: Add, context: &mut Self::Context) -> u32 {
            self.0.set(self.0.get() + 1);
            if self.0.get() < ROUNDS {
                context.address().do_send(Add);
            }
            0
        }
    }
    run(async {
        let rounds = Rc::new(Cell::new(0));
        let whirl = Whirl(Rc::clone(&rounds)).start();

        whirl.do_send(Add);
        let neighbour = tokio::task::spawn_local(async move { rounds.get() });

        let seen = neighbour.await.expect("the neighbour returns");
        assert_eq!(seen, ROUNDS, "the neighbour had its turn when all was done");
    });
}

#[test]
fn a_message_to_a_dead_address_vanishes_without_a_word() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let subject = subject.start();
        subject.do_send(End::Stop);
        settle().await;

        // `do_send` returns nothing, and nothing happens.
        subject.do_send(Run(Box::new(|subject, _| subject.log.borrow_mut().push("served"))));
        settle().await;

        assert_eq!(*log.borrow(), ["started", "stopped"]);
    });
}

#[test]
fn an_actor_started_on_an_arbiter_that_is_gone_is_born_dead_without_an_error() {
    let _turn = blastema_doubles::turn();
    run(async {
        let arbiter = Arbiter::new();
        let handle = arbiter.handle();
        arbiter.stop();
        assert!(arbiter.join().is_ok());

        let subject = Subject::start_in_arbiter(&handle, |_| Subject::default());

        assert!(!subject.connected());
    });
}

/// Panics in a future that actix runs as a task of its own.
#[derive(Message)]
#[rtype(result = "u32")]
struct PanicLater;

impl Handler<PanicLater> for Subject {
    type Result = ResponseFuture<u32>;

    fn handle(&mut self, PanicLater: PanicLater, _: &mut Self::Context) -> ResponseFuture<u32> {
        Box::pin(async { panic!("in a task of its own") })
    }
}

#[test]
fn a_panic_in_a_response_future_kills_nobody_and_is_told_to_nobody() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let subject = subject.start();

        assert_eq!(subject.send(PanicLater).await, Err(MailboxError::Closed));

        assert_eq!(subject.send(Add).await, Ok(1));
        assert_eq!(*log.borrow(), ["started"]);
    });
}

#[test]
fn after_a_block_an_interval_fires_every_stale_tick_at_once() {
    let _turn = blastema_doubles::turn();
    run_paused(async {
        let subject = Subject::default().start();
        let every = Duration::from_millis(10);
        subject
            .send(Run(Box::new(move |_, context| {
                context.run_interval(every, |subject, _| subject.sum += 1);
            })))
            .await
            .expect("the subject lives");
        settle().await;

        // The clock leaps as it does for an arbiter whose thread was kept for a second.
        tokio::time::advance(Duration::from_secs(1)).await;
        settle().await;

        assert_eq!(subject.send(Add).await, Ok(101), "a hundred ticks in one instant");
    });
}

#[test]
fn actors_run_on_a_paused_clock() {
    let _turn = blastema_doubles::turn();
    run_paused(async {
        let subject = Subject::default().start();
        subject.do_send(Run(Box::new(|_, context| {
            context.run_interval(Duration::from_secs(1), |subject, _| subject.sum += 1);
        })));

        tokio::time::sleep(Duration::from_millis(3_600_500)).await;

        assert_eq!(subject.send(Add).await, Ok(3_601), "an hour of ticks, in no time");
    });
}

#[test]
fn every_arbiter_has_a_clock_of_its_own() {
    let _turn = blastema_doubles::turn();
    run_paused(async {
        let arbiter = Arbiter::new();
        let (tell, told) = mpsc::channel();
        let ask = || {
            let tell = tell.clone();
            arbiter.spawn_fn(move || {
                tell.send(tokio::time::Instant::now()).expect("the test waits");
            });
            told.recv().expect("the arbiter answers")
        };
        let before = ask();

        tokio::time::advance(Duration::from_secs(3_600)).await;

        assert!(ask() - before < Duration::from_secs(3_600), "only our own clock leapt");
        arbiter.stop();
        assert!(arbiter.join().is_ok());
    });
}

/// What an actor is to the runtime, polled by the test itself as a guard does.
type ContextTask = Pin<Box<ContextFut<Subject, Context<Subject>>>>;

fn by_hand(subject: Subject) -> (Addr<Subject>, ContextTask) {
    let context = Context::new();
    let address = context.address();
    (address, Box::pin(context.into_future(subject)))
}

/// Polls it once; an error is a panic that came out of the poll.
fn turn(task: &mut ContextTask) -> std::thread::Result<Poll<()>> {
    let mut cx = std::task::Context::from_waker(std::task::Waker::noop());
    catch_unwind(AssertUnwindSafe(|| task.as_mut().poll(&mut cx)))
}

#[test]
fn a_context_future_that_is_restarted_after_a_panic_keeps_address_and_mailbox() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let (address, mut task) = by_hand(subject);
        let recipient = address.clone().recipient::<Add>();
        address.do_send(Add);
        address.do_send(End::Panic);
        address.do_send(Add);

        assert!(turn(&mut task).is_err());
        assert!(address.connected());
        assert!(task.restart());

        let guarded = tokio::task::spawn_local(task);
        assert_eq!(recipient.send(Add).await, Ok(3), "the old recipient reaches the new task");
        assert!(recipient == address.clone().recipient(), "and equals a new one");
        assert_eq!(*log.borrow(), ["started", "restarting", "started"]);
        guarded.abort();
    });
}

#[test]
fn recipients_are_equal_when_they_lead_to_the_same_actor() {
    let _turn = blastema_doubles::turn();
    run(async {
        let one = Subject::default().start();
        let other = Subject::default().start();

        assert!(one.clone().recipient::<Add>() == one.clone().recipient());
        assert!(one.recipient::<Add>() != other.recipient());
    });
}

#[test]
fn a_panic_that_is_caught_inside_the_poll_is_never_seen_by_actix() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let subject = subject.start();

        subject.do_send(Run(Box::new(|subject, context| {
            let mut component = Box::pin(async { panic!("in the component") });
            let guard = poll_fn(move |cx| {
                let poll = catch_unwind(AssertUnwindSafe(|| component.as_mut().poll(cx)));
                poll.unwrap_or(Poll::Ready(()))
            });
            context.spawn(guard.into_actor(subject).map(|(), subject: &mut Subject, _| {
                subject.log.borrow_mut().push("guarded");
            }));
        })));
        settle().await;

        assert_eq!(subject.send(Add).await, Ok(1));
        assert_eq!(*log.borrow(), ["started", "guarded"]);
    });
}

#[test]
fn the_mailbox_is_served_before_the_futures_of_its_actor() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (subject, log) = Subject::with_log();
        let (address, mut task) = by_hand(subject);
        address.do_send(Run(Box::new(|subject, context| {
            let log = Rc::clone(&subject.log);
            // A pump that always has more to do, as that of a flooded component.
            let pump = poll_fn(move |cx| {
                log.borrow_mut().push("data");
                cx.waker().wake_by_ref();
                Poll::<()>::Pending
            });
            context.spawn(pump.into_actor(subject));
        })));
        assert!(turn(&mut task).is_ok_and(|poll| poll.is_pending()));
        log.borrow_mut().clear();

        address.do_send(Run(Box::new(|subject, _| subject.log.borrow_mut().push("control"))));
        assert!(turn(&mut task).is_ok_and(|poll| poll.is_pending()));

        assert_eq!(*log.borrow(), ["control", "data"]);
    });
}

#[test]
fn waiting_in_the_context_stops_the_mailbox_and_the_timers() {
    let _turn = blastema_doubles::turn();
    run_paused(async {
        let (subject, log) = Subject::with_log();
        let subject = subject.start();
        subject.do_send(Run(Box::new(|subject, context| {
            context.run_interval(Duration::from_millis(10), |subject, _| {
                subject.log.borrow_mut().push("tick");
            });
            context.wait(std::future::pending::<()>().into_actor(subject));
        })));

        let mut request = pin!(subject.send(Add));
        let answered = tokio::time::timeout(Duration::from_secs(10), request.as_mut()).await;

        assert!(answered.is_err());
        assert_eq!(*log.borrow(), ["started"]);
        assert!(subject.connected());
    });
}

#[test]
fn an_actor_without_an_address_stops_but_a_timer_keeps_it() {
    let _turn = blastema_doubles::turn();
    run_paused(async {
        let (idle, idle_log) = Subject::with_log();
        let (busy, busy_log) = Subject::with_log();
        drop(idle.start());
        let busy = busy.start();
        busy.do_send(Run(Box::new(|_, context| {
            context.run_interval(Duration::from_secs(1), |_, _| {});
        })));
        drop(busy);

        tokio::time::sleep(Duration::from_secs(10)).await;

        assert_eq!(*idle_log.borrow(), ["started", "stopped"]);
        assert_eq!(*busy_log.borrow(), ["started"]);
    });
}
