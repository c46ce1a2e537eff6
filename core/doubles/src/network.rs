//! A medium with several ends, in virtual time, the same for one seed.

use crate::mock_transport::{Arrival, MockTransport};
use crate::paused::now;
use actix::Recipient;
use blastema_core::medium::impairment::{ImpairedDirection, Impairment, Injected};
use blastema_core::{Instant, Machine};
use bytes::Bytes;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// So many frames may be under way from one end to another: more than any test should need.
const UNDER_WAY: usize = 1 << 16;

/// Connects [`MockTransport`]s; each way from one end to another can be made bad, cut and restored.
///
/// See the [crate](crate) for an example.
#[derive(Clone)]
pub struct SimulatedNetwork(Arc<Mutex<Ends>>);

struct Ends {
    seed: u64,
    ends: BTreeMap<Arc<str>, Recipient<Arrival>>,
    ways: BTreeMap<(Arc<str>, Arc<str>), Way>,
}

/// One direction between two ends.
struct Way {
    medium: ImpairedDirection<Bytes>,
    /// For when the sender has a timer running: one for all frames that are under way.
    armed: Option<Instant>,
}

impl SimulatedNetwork {
    /// A network without ends and faults. All that is left to chance follows from the seed.
    pub fn new(seed: u64) -> Self {
        SimulatedNetwork(Arc::new(Mutex::new(Ends {
            seed,
            ends: BTreeMap::new(),
            ways: BTreeMap::new(),
        })))
    }

    /// Opens the end of this name; it replaces one that was there.
    pub fn end(&self, name: &str) -> MockTransport {
        MockTransport::on(name, Some(self.clone()))
    }

    /// Makes the way from one end to another this bad.
    pub fn impair(&self, from: &str, to: &str, impairment: Impairment) {
        self.ends().way(from, to).medium.impair(impairment);
    }

    /// Cuts both ways between two ends, silently. What is under way is lost.
    pub fn cut(&self, one: &str, other: &str) {
        let mut ends = self.ends();
        ends.way(one, other).medium.cut();
        ends.way(other, one).medium.cut();
    }

    /// Restores both ways between two ends.
    pub fn restore(&self, one: &str, other: &str) {
        let mut ends = self.ends();
        ends.way(one, other).medium.restore();
        ends.way(other, one).medium.restore();
    }

    /// What was done to frames on the way from one end to another.
    pub fn injected(&self, from: &str, to: &str) -> Injected {
        self.ends().way(from, to).medium.injected()
    }

    fn ends(&self) -> MutexGuard<'_, Ends> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn enter(&self, name: &Arc<str>, end: Recipient<Arrival>) {
        self.ends().ends.insert(name.clone(), end);
    }

    pub(crate) fn leave(&self, name: &Arc<str>) {
        self.ends().ends.remove(name);
    }

    /// Takes a frame in and delivers what is due. The answer is after which time to call [`turn`],
    /// if that is sooner than it would be called anyway.
    ///
    /// [`turn`]: Self::turn
    pub(crate) fn transmit(&self, from: &Arc<str>, to: &str, frame: Bytes) -> Option<Duration> {
        let mut ends = self.ends();
        ends.way(from, to).medium.handle_frame(frame, now());
        ends.carry(from, to)
    }

    /// Delivers what is due on one way; the answer is as for [`transmit`](Self::transmit).
    pub(crate) fn turn(&self, from: &Arc<str>, to: &str) -> Option<Duration> {
        let mut ends = self.ends();
        ends.way(from, to).armed = None;
        ends.carry(from, to)
    }
}

impl Ends {
    fn carry(&mut self, from: &Arc<str>, to: &str) -> Option<Duration> {
        let now = now();
        let receiver = self.ends.get(to).cloned();
        let Way { medium, armed } = self.way(from, to);
        medium.handle_timeout(now);
        while let Some(frame) = medium.poll_output() {
            if let Some(receiver) = &receiver {
                receiver.do_send(Arrival { from: from.clone(), frame });
            }
        }
        let due = medium.poll_timeout()?;
        if armed.is_some_and(|armed| armed <= due) {
            return None;
        }
        *armed = Some(due);
        Some(due - now)
    }

    fn way(&mut self, from: &str, to: &str) -> &mut Way {
        let seed = self.seed;
        self.ways.entry((from.into(), to.into())).or_insert_with_key(|(from, to)| {
            // Each way has a sequence of its own, so that traffic on one does not change another.
            let names = from.bytes().chain([0]).chain(to.bytes());
            let mixed = names.fold(seed, |mixed, byte| {
                (mixed ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3)
            });
            Way { medium: ImpairedDirection::new(mixed, UNDER_WAY), armed: None }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Probe, advance, paused};
    use blastema_contract::transport::{Attach, Received, Transmit};

    const MS: fn(u64) -> Duration = Duration::from_millis;

    fn attach(end: &MockTransport) -> Probe<Received> {
        let (frames, reports) = (Probe::start(), Probe::start());
        let (to, reports) = (frames.recipient(), reports.recipient());
        end.transport().attach.do_send(Attach::new(to, reports));
        frames
    }

    fn send(from: &MockTransport, to: &MockTransport, numbers: std::ops::Range<u8>) {
        for number in numbers {
            let frame = Bytes::copy_from_slice(&[number]);
            from.transport().transmit.do_send(Transmit::new(to.local(), frame.into()));
        }
    }

    fn numbers(probe: &Probe<Received>) -> Vec<u8> {
        probe.drain().iter().map(|received| received.frame[0]).collect()
    }

    #[test]
    fn a_cut_way_says_nothing_and_passes_nothing_until_it_is_mended() {
        paused(async {
            let network = SimulatedNetwork::new(1);
            let (a, b, c) = (network.end("a"), network.end("b"), network.end("c"));
            let (at_b, at_c) = (attach(&b), attach(&c));
            network.impair("a", "b", Impairment { delay: MS(5), ..Impairment::NONE });

            send(&a, &b, 0..3);
            advance(MS(4)).await;
            network.cut("a", "b");
            send(&a, &b, 3..6);
            send(&a, &c, 0..1);
            advance(MS(100)).await;
            assert_eq!(numbers(&at_b), []);
            assert_eq!(numbers(&at_c), [0]);

            network.restore("a", "b");
            send(&a, &b, 6..9);
            advance(MS(1)).await;
            assert_eq!(numbers(&at_b), [6, 7, 8]);
            assert_eq!(network.injected("a", "b").cut, 6);
        });
    }

    #[test]
    fn one_seed_gives_one_run() {
        let run = |seed| {
            paused(async move {
                let network = SimulatedNetwork::new(seed);
                let (a, b) = (network.end("a"), network.end("b"));
                let at_b = attach(&b);
                let bad = Impairment {
                    loss: 0.3,
                    duplication: 0.2,
                    delay: MS(5),
                    jitter: MS(20),
                    ..Impairment::NONE
                };
                network.impair("a", "b", bad);
                send(&a, &b, 0..200);
                advance(MS(100)).await;
                numbers(&at_b)
            })
        };

        assert_eq!(run(7), run(7));
        assert_ne!(run(7), run(8));
        assert!((130..220).contains(&run(7).len()));
    }
}
