//! When a session acts by itself.

use super::{Session, State};
use crate::timer::Timers;
use crate::{Instant, TrafficClass};

/// The timers of a session.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SessionTimer {
    /// Ends a session, or returns its messages, when the peer has owed an answer, or had no path,
    /// for `idle_timeout`, or four times as long while messages of the last session are not
    /// settled; with a path for three retransmission timeouts at least (QUIC: idle timeout; TCP:
    /// user timeout, RFC 5482).
    Idle,
    /// Sends again what is in flight of a stream: a retransmission timeout after its first chunk
    /// there (RFC 6298).
    Loss(TrafficClass),
    /// Takes datagrams for lost of which the peer has told nothing: a retransmission timeout of
    /// events after the first of them.
    LossDatagrams,
    /// Repeats the handshake while there is a path (TCP: SYN timer).
    OpenRetransmit,
    /// Repeats the close, [`Session::CLOSE_TRIES`] times in all (TCP: FIN timer).
    CloseRetransmit,
    /// Lets `poll_output` acknowledge received data that nothing has taken along: `ACK_DELAY`, up
    /// to 50 ms on a narrow path (QUIC: `max_ack_delay`).
    AckDelay,
    /// Lets `poll_output` send what would have stood in queues before (RFC 9002, 7.7).
    Pacing,
}

impl Timers for Session {
    type Timer = SessionTimer;

    const TIMERS: &'static [SessionTimer] = {
        use SessionTimer::*;
        &[
            Idle,
            Loss(TrafficClass::Control),
            Loss(TrafficClass::Redundant),
            Loss(TrafficClass::Replication),
            Loss(TrafficClass::Request),
            Loss(TrafficClass::Event),
            Loss(TrafficClass::Bulk),
            LossDatagrams,
            OpenRetransmit,
            CloseRetransmit,
            AckDelay,
            Pacing,
        ]
    };

    fn due(&self, timer: SessionTimer) -> Option<Instant> {
        match (timer, self.state) {
            (SessionTimer::Idle, _) => {
                // Where an answer takes long, one that is lost is asked for twice before that.
                let longest = self.streams.iter().map(|stream| stream.rtt.timeout()).max();
                let answers = longest.filter(|_| self.path.mtu.is_some()).unwrap_or_default() * 3;
                let times =
                    if self.identity.unsettled.is_some() { Session::SETTLE_TIMES } else { 1 };
                Some(self.path.waiting_since? + (self.config.idle_timeout * times).max(answers))
            }
            (SessionTimer::Loss(stream), _) => self.streams[stream as usize].retransmit_at,
            (SessionTimer::LossDatagrams, _) => self.datagrams.lost_at,
            (SessionTimer::OpenRetransmit, State::Opening { again_at, .. }) => {
                self.path.mtu.map(|_| again_at)
            }
            (SessionTimer::CloseRetransmit, State::Closing { again_at, .. }) => again_at,
            (SessionTimer::OpenRetransmit | SessionTimer::CloseRetransmit, _) => None,
            (SessionTimer::AckDelay, _) => self.ack_owed(),
            (SessionTimer::Pacing, _) => self.paced_until(),
        }
    }

    fn fire(&mut self, timer: SessionTimer, _: Instant) {
        match timer {
            SessionTimer::Idle => self.give_up(),
            SessionTimer::Loss(stream) => self.detect_loss(stream),
            SessionTimer::LossDatagrams => self.detect_lost_datagrams(),
            SessionTimer::OpenRetransmit => self.transmit_open(),
            SessionTimer::CloseRetransmit => self.repeat_close(),
            SessionTimer::AckDelay | SessionTimer::Pacing => {}
        }
    }
}
