//! A clock that stands until all tasks wait, and then jumps to the next instant that is due.

use blastema_core::Instant;
use std::cell::Cell;
use std::time::Duration;

/// So many turns are left to the actors to settle. A turn runs up to 61 tasks, and a message needs
/// one turn for each actor on its way at most: longer ways than this are no longer a unit's test.
const TURNS: usize = 128;

thread_local! {
    static ORIGIN: Cell<Option<tokio::time::Instant>> = const { Cell::new(None) };
}

/// Runs a test in an actix system whose one arbiter has a paused clock: hours pass in milliseconds,
/// and a test that waits is never slower than what it tests.
///
/// All actors must be on this arbiter: another one has a clock of its own. Sockets do not mix with
/// it either: the clock jumps while bytes are under way.
///
/// # Panics
/// When the test does, or when there is a system on this thread already.
///
/// # Examples
/// ```
/// use blastema_doubles::{advance, now, paused};
/// use std::time::Duration;
///
/// paused(async {
///     let before = now();
///     advance(Duration::from_secs(3600)).await;
///     assert_eq!(now() - before, Duration::from_secs(3600));
/// });
/// ```
pub fn paused<F: Future>(test: F) -> F::Output {
    actix_rt::System::with_tokio_rt(|| {
        tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .start_paused(true)
            .build()
            .expect("a test may open an event queue")
    })
    .block_on(async {
        ORIGIN.set(Some(tokio::time::Instant::now()));
        test.await
    })
}

/// Lets this time pass: everything due on the way happens, each at its own instant and in order,
/// and all actors have settled when it returns. Timers are exact to the millisecond.
pub async fn advance(span: Duration) {
    settle().await;
    tokio::time::sleep(span).await;
    settle().await;
}

/// Lets all actors handle what they were sent, while the clock stands.
pub async fn settle() {
    for _ in 0..TURNS {
        tokio::task::yield_now().await;
    }
}

/// The time on tokio's clock, as machines are given it; zero where [`paused`](fn@paused) began.
pub fn now() -> Instant {
    let now = tokio::time::Instant::now();
    let origin = ORIGIN.get().unwrap_or_else(|| {
        ORIGIN.set(Some(now));
        now
    });
    Instant::ORIGIN + now.saturating_duration_since(origin)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Probe;
    use actix::prelude::*;

    /// Sends each message on to the next, so that it takes as many turns as there are.
    struct Relay(Recipient<Step>);

    #[derive(Clone, Message)]
    #[rtype(result = "()")]
    struct Step;

    impl Actor for Relay {
        type Context = Context<Self>;
    }

    impl Handler<Step> for Relay {
        type Result = ();
        fn handle(&mut self, step: Step, _: &mut Context<Self>) {
            self.0.do_send(step);
        }
    }

    #[test]
    fn actors_settle_over_many_hops_while_the_clock_stands() {
        paused(async {
            let probe = Probe::<Step>::start();
            let chain = (0..50).fold(probe.recipient(), |next, _| Relay(next).start().recipient());

            chain.do_send(Step);
            settle().await;

            assert_eq!(probe.drain().len(), 1);
            assert_eq!(now(), Instant::ORIGIN);
        });
    }

    #[test]
    fn timers_fire_one_by_one_at_their_own_instants() {
        struct Ticker(Recipient<Tick>);
        #[derive(Message, Debug, PartialEq)]
        #[rtype(result = "()")]
        struct Tick(Instant);
        impl Actor for Ticker {
            type Context = Context<Self>;
            fn started(&mut self, context: &mut Context<Self>) {
                context.run_interval(Duration::from_millis(10), |ticker, _| {
                    ticker.0.do_send(Tick(now()));
                });
            }
        }
        paused(async {
            let probe = Probe::<Tick>::start();
            let ticker = Ticker(probe.recipient()).start();

            advance(Duration::from_millis(30)).await;

            let expected = [10, 20, 30].map(|ms| Tick(Instant::from_millis(ms)));
            assert_eq!(probe.drain(), expected);
            drop(ticker);
        });
    }
}
