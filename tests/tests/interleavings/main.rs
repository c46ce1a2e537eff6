//! Every order in which threads can take their steps, in the parts where that order matters.
//!
//! loom runs each model below once for each order, and for each value that the memory model of the
//! language lets a load see. The sources are the product's own, built here a second time: they name
//! their atomics and locks in `crate::sync`, and here that is loom's. What they need of the rest of
//! the product and no model touches has stand-ins.
//!
//! ```text
//! cargo test -p blastema-tests --test interleavings             # all models
//! cargo test -p blastema-tests --test interleavings -- reply    # those with this in their name
//! LOOM_MAX_PREEMPTIONS=4 LOOM_LOG=1 cargo test ..               # deeper; and what a failing one did
//! ```

mod activity;
mod arbiter;
mod component;
mod hubs;
mod liveness;
mod messaging;
mod queues;
mod replies;
mod tokens;

use loom::model::Builder;
use std::sync::Arc;
use std::task::{Wake, Waker};

/// What the product takes from std.
mod sync {
    pub(crate) use loom::sync::{Mutex, MutexGuard, atomic};
}

/// Stands for the only place that reads a clock.
mod platform {
    pub(crate) fn now() -> blastema_core::Instant {
        blastema_core::Instant::ORIGIN
    }
}

/// Switches from a thread that could go on, in one run. Two find nearly every fault that is known
/// of such code (Musuvathi and Qadeer, 2007); three leave room, and the whole takes seconds.
const PREEMPTIONS: usize = 3;

/// Lets one thread wait until another wakes it.
struct Bell(loom::sync::Notify);

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.0.notify();
    }
}

fn bell() -> (Arc<Bell>, Waker) {
    let bell = Arc::new(Bell(loom::sync::Notify::new()));
    (bell.clone(), Waker::from(bell))
}

type Model = (&'static str, fn());

/// No test harness: it would let models run beside each other, and run the unit tests of the
/// product's files, which have no model around them.
#[expect(clippy::print_stdout, reason = "it says which model runs, as a test harness does")]
fn main() {
    let wanted: Vec<String> =
        std::env::args().skip(1).filter(|word| !word.starts_with('-')).collect();
    let models =
        [&queues::MODELS[..], &replies::MODELS, &tokens::MODELS, &activity::MODELS, &hubs::MODELS];
    let chosen = |name: &str| wanted.is_empty() || wanted.iter().any(|word| name.contains(word));
    for (name, model) in models.into_iter().flatten().filter(|(name, _)| chosen(name)) {
        let mut builder = Builder::new();
        builder.preemption_bound = builder.preemption_bound.or(Some(PREEMPTIONS));
        println!("model {name}");
        builder.check(model);
    }
}
