//! What the messages of one topic tell of the way that they took.

use super::judge::Latency;
use crate::Instant;
use std::time::Duration;

/// One message that arrived.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TopicArrival {
    /// When it arrived.
    pub at: Instant,
    /// How much longer it took than the fastest message of late.
    pub age: Duration,
    /// Its number among the messages of its sender, where they are numbered. Each sender begins
    /// with a number by chance, so that the numbers of two are far apart.
    pub sequence: Option<u64>,
    /// When it arrived, and when it was sent by the sender's clock, in microseconds of wall time.
    pub stamps_us: Option<(u64, u64)>,
}

/// Estimates loss as the share of the last 64 messages, weighted towards the newest.
#[derive(Clone, Copy, Debug, Default)]
pub struct LossEstimator {
    loss: f64,
}

impl LossEstimator {
    /// The weight of one message: as many as a link's loss is counted over.
    const WEIGHT: f64 = 1.0 / 64.0;
    /// A longer run of lost messages says nothing more.
    const RUN_MAX: u64 = 512;

    /// So many messages were lost, and then so many arrived.
    pub fn handle(&mut self, lost: u64, arrived: u64) {
        let keep = |count: u64| (1.0 - Self::WEIGHT).powi(count.min(Self::RUN_MAX) as i32);
        self.loss = 1.0 - (1.0 - self.loss) * keep(lost);
        self.loss *= keep(arrived);
    }

    /// How many of a thousand messages are lost.
    pub fn permille(&self) -> u16 {
        (self.loss * 1000.0).round() as u16
    }
}

/// How many senders of one topic are told apart: an operator, and those who stand by.
const SENDERS: usize = 4;

/// Measures a topic by the messages that arrive.
#[derive(Clone, Copy, Debug, Default)]
pub struct TopicEstimator {
    arrived: u64,
    last: Option<TopicArrival>,
    age_us: Option<i64>,
    jitter: Duration,
    loss: LossEstimator,
    /// The last numbers of the senders, that of the last message first.
    numbers: [Option<u64>; SENDERS],
    /// How much later by our clock it arrived than it was sent by the sender's, in microseconds.
    one_way_us: Option<i64>,
}

/// Returns the smoothed figure: an eighth of each new one counts (RFC 6298).
fn smoothed(before: Option<i64>, sample: i64) -> i64 {
    before.map_or(sample, |before| before + (sample - before) / 8)
}

fn micros(span: Duration) -> i64 {
    i64::try_from(span.as_micros()).unwrap_or(i64::MAX / 2)
}

impl TopicEstimator {
    /// A message has arrived.
    pub fn handle_arrival(&mut self, arrival: TopicArrival) {
        let last = self.last.replace(arrival);
        self.arrived += 1;
        let lost = arrival.sequence.map_or(0, |sequence| self.lost_before(sequence));
        self.loss.handle(lost, 1);
        let last_age = last.map_or(arrival.age, |last| last.age);
        // The jitter of RFC 3550.
        self.jitter = (self.jitter * 15 + last_age.abs_diff(arrival.age)) / 16;
        self.age_us = Some(smoothed(self.age_us, micros(arrival.age)));
        if let Some((received, sent)) = arrival.stamps_us {
            let bounded = |us: u64| i64::try_from(us).unwrap_or(i64::MAX / 2).min(i64::MAX / 2);
            self.one_way_us = Some(smoothed(self.one_way_us, bounded(received) - bounded(sent)));
        }
    }

    /// How many messages are missing between this one and the last one of its sender.
    fn lost_before(&mut self, sequence: u64) -> u64 {
        let gap = |known: &Option<u64>| sequence.checked_sub((*known)?)?.checked_sub(1);
        let near = |known: &Option<u64>| gap(known).filter(|gap| *gap <= LossEstimator::RUN_MAX);
        let known = (0..SENDERS).filter_map(|at| Some((near(&self.numbers[at])?, at))).min();
        // A number that follows none is that of a sender that is new, or of a message that was
        // overtaken.
        let (lost, at) = known.unwrap_or((0, SENDERS - 1));
        self.numbers[..=at].rotate_right(1);
        self.numbers[0] = Some(sequence);
        lost
    }

    /// How many messages have arrived.
    pub fn arrived(&self) -> u64 {
        self.arrived
    }

    /// When the last one arrived.
    pub fn heard_at(&self) -> Option<Instant> {
        self.last.map(|last| last.at)
    }

    /// The smoothed deviation of the passage from one message to the next.
    pub fn jitter(&self) -> Duration {
        self.jitter
    }

    /// How many of a thousand messages are lost, where they are numbered.
    pub fn loss_permille(&self) -> Option<u16> {
        self.last?.sequence.map(|_| self.loss.permille())
    }

    fn age(&self) -> Duration {
        Duration::from_micros(self.age_us.unwrap_or_default().unsigned_abs())
    }

    /// How long a message takes, if the fastest round trip of late took so long. The fastest
    /// message took no longer than that, and each other one its age in addition.
    pub fn latency(&self, round_trip: Duration) -> Latency {
        Latency { estimate: self.age() + round_trip / 2, error: round_trip / 2 }
    }

    /// How long a message takes by two clocks that agree within `error`. `None` where messages have
    /// no stamps, and where the clocks do not agree: no message takes less than no time, or longer
    /// than its age and the fastest round trip.
    pub fn one_way(&self, error: Duration, round_trip: Duration) -> Option<Latency> {
        let passage = self.one_way_us?;
        let most = micros(self.age() + round_trip + error);
        let agree = (-micros(error)..=most).contains(&passage);
        let estimate = Duration::from_micros(u64::try_from(passage).unwrap_or(0));
        agree.then_some(Latency { estimate, error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn numbered(sequence: u64) -> TopicArrival {
        TopicArrival { sequence: Some(sequence), ..TopicArrival::default() }
    }

    #[test]
    fn loss_is_the_share_of_missing_numbers_and_a_restarted_sender_loses_nothing() {
        let mut topic = TopicEstimator::default();
        topic.handle_arrival(TopicArrival::default());
        assert_eq!(topic.loss_permille(), None, "it is not numbered");
        for sequence in (0..1000).filter(|sequence| sequence % 4 != 0) {
            topic.handle_arrival(numbered(sequence));
        }
        let loss = topic.loss_permille().expect("it is numbered");
        assert!((230..270).contains(&loss), "{loss}");
        (0..500).for_each(|sequence| topic.handle_arrival(numbered(sequence)));
        assert!(topic.loss_permille() < Some(5), "{topic:?}");
    }

    #[test]
    fn senders_of_one_topic_are_told_apart_by_their_numbers() {
        let mut topic = TopicEstimator::default();
        let begin = [7 << 40, 3 << 50, 5 << 60];
        for count in 0..300 {
            for sender in begin {
                topic.handle_arrival(numbered(sender + count));
            }
        }
        assert_eq!(topic.loss_permille(), Some(0));
        // The second loses half of its messages.
        for count in (300..900).step_by(2) {
            topic.handle_arrival(numbered(begin[0] + count / 2 + 150));
            topic.handle_arrival(numbered(begin[1] + count));
        }
        let loss = topic.loss_permille().expect("it is numbered");
        assert!((300..370).contains(&loss), "{loss}");
    }

    #[test]
    fn clocks_that_agree_tell_the_passage_and_others_are_found_out() {
        let stamped = |passage_us: i64| {
            let mut topic = TopicEstimator::default();
            let received = 1_000_000_u64.checked_add_signed(passage_us).expect("it is small");
            let stamps_us = Some((received, 1_000_000));
            (0..3).for_each(|_| {
                topic.handle_arrival(TopicArrival { stamps_us, ..TopicArrival::default() })
            });
            topic.one_way(MS, 60 * MS).map(|latency| latency.estimate)
        };
        assert_eq!(stamped(50_000), Some(50 * MS), "and not 30 ms, half of the round trip");
        assert_eq!(stamped(-500), Some(Duration::ZERO), "within the error");
        assert_eq!(stamped(-2_000), None, "it arrived before it was sent");
        assert_eq!(stamped(62_000), None, "longer than a round trip");
        assert_eq!(TopicEstimator::default().latency(60 * MS).most(), 60 * MS);
    }
}
