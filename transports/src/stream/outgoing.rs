//! Frames that wait for a connection to take them.

use super::framing::{HEADER, encode_header};
use blastema_contract::transport::TransmitBacklog;
use blastema_core::medium::lane::FrameLane;
use blastema_core::{GatherBuffer, Instant};
use std::collections::VecDeque;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{self, Poll};
use tokio::io::AsyncWrite;

/// So many frames go into one system call.
const AT_ONCE: usize = 32;
/// A frame's length, and its two pieces.
const SLICES: usize = 3;
/// What a frame costs beside its bytes, so that empty frames have a bound too.
const OVERHEAD: usize = 64;

/// A frame with its lane, and since when it waits, where that is known.
pub(super) type WaitingFrame = (FrameLane, GatherBuffer, Option<Instant>);

/// A bounded queue of frames before one peer, the urgent before the usual.
#[derive(Default)]
pub(super) struct StreamSendQueue {
    frames: VecDeque<WaitingFrame>,
    /// What the frames of each lane cost together, in the order in which they go.
    costs: [usize; 3],
    /// How much of the first frame, with its header, is written already.
    written: usize,
}

impl StreamSendQueue {
    /// Takes a frame, unless those of its lane would cost more than `limit` bytes together.
    pub(super) fn push(&mut self, waiting: WaitingFrame, limit: usize) -> bool {
        let (lane, frame, since) = waiting;
        let cost = &mut self.costs[lane as usize];
        let more = *cost + frame.len() + OVERHEAD;
        if more > limit {
            return false;
        }
        *cost = more;
        match lane {
            FrameLane::Usual => self.frames.push_back((lane, frame, since)),
            FrameLane::Hello | FrameLane::Urgent => {
                // Behind the one that has begun, and behind those that wait and are as urgent.
                let begun = usize::from(self.written > 0);
                let waiting = self.frames.iter().skip(begun);
                let ahead = waiting.take_while(|(other, _, _)| *other <= lane).count();
                let place = (begun + ahead).min(self.frames.len());
                self.frames.insert(place, (lane, frame, since));
            }
        }
        true
    }

    /// What waits, the frame that has begun included.
    pub(super) fn backlog(&self, now: Option<Instant>) -> TransmitBacklog {
        let oldest = self.frames.iter().filter_map(|(_, _, since)| *since).min();
        TransmitBacklog::since(self.frames.len(), oldest, now)
    }

    /// Throws everything away; the answer is how many frames that were.
    pub(super) fn clear(&mut self) -> u64 {
        let frames = self.frames.len();
        *self = StreamSendQueue::default();
        frames as u64
    }

    /// A new connection begins with a whole frame.
    pub(super) fn rewind(&mut self) {
        self.written = 0;
    }

    /// Puts what waits here behind what waits in `first`, which has begun on the connection that is
    /// used from now on.
    pub(super) fn follow(&mut self, first: StreamSendQueue) {
        for waiting in std::mem::replace(self, first).frames {
            self.push(waiting, usize::MAX);
        }
    }

    /// Writes until all is written or the kernel has no more room; the answer is how many frames
    /// went out whole.
    pub(super) fn write(
        &mut self,
        stream: &mut (impl AsyncWrite + Unpin),
        task: &mut task::Context<'_>,
    ) -> io::Result<u64> {
        let mut sent = 0;
        while !self.frames.is_empty()
            && let Poll::Ready(frames) = self.write_once(stream, task)?
        {
            sent += frames;
        }
        Ok(sent)
    }

    fn write_once(
        &mut self,
        stream: &mut (impl AsyncWrite + Unpin),
        task: &mut task::Context<'_>,
    ) -> io::Result<Poll<u64>> {
        let mut headers = [[0; HEADER]; AT_ONCE];
        for (header, (_, frame, _)) in headers.iter_mut().zip(&self.frames) {
            *header = encode_header(frame.len());
        }
        let mut slices = [IoSlice::new(&[]); SLICES * AT_ONCE];
        for (own, (header, (_, frame, _))) in
            slices.chunks_exact_mut(SLICES).zip(headers.iter().zip(&self.frames))
        {
            let [head, body] = frame.pieces();
            own.copy_from_slice(&[header, head, body].map(IoSlice::new));
        }
        let mut slices = &mut slices[..SLICES * self.frames.len().min(AT_ONCE)];
        IoSlice::advance_slices(&mut slices, self.written);
        match Pin::new(stream).poll_write_vectored(task, slices)? {
            Poll::Ready(0) => Err(io::ErrorKind::WriteZero.into()),
            written => Ok(written.map(|written| self.advance(written))),
        }
    }

    /// So many bytes more have gone out; the answer is how many frames they completed.
    fn advance(&mut self, bytes: usize) -> u64 {
        self.written += bytes;
        let mut completed = 0;
        while let Some((lane, first, _)) = self.frames.front()
            && self.written >= HEADER + first.len()
        {
            self.written -= HEADER + first.len();
            self.costs[*lane as usize] -= first.len() + OVERHEAD;
            self.frames.pop_front();
            completed += 1;
        }
        completed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_complete_when_their_last_byte_is_written() {
        let mut outgoing = StreamSendQueue::default();
        for frame in ["", "abc", "", "de"] {
            assert!(outgoing.push((FrameLane::Usual, frame.into(), None), 1 << 20));
        }

        let completed = [3, 1, 6, 1, 4, 6].map(|bytes| outgoing.advance(bytes));

        assert_eq!(completed, [0, 1, 0, 1, 1, 1]);
        assert_eq!((outgoing.costs, outgoing.written, outgoing.frames.len()), ([0; 3], 0, 0));
    }

    #[test]
    fn the_queue_is_bounded_for_empty_frames_too() {
        let mut outgoing = StreamSendQueue::default();

        let taken = (0..10_000)
            .filter(|_| outgoing.push((FrameLane::Usual, GatherBuffer::default(), None), 64 * 100))
            .count();

        assert_eq!(taken, 100);
        assert!(
            outgoing.push((FrameLane::Urgent, GatherBuffer::default(), None), 64),
            "the urgent has a place of its own"
        );
        assert_eq!(outgoing.clear(), 101);
    }

    #[test]
    fn what_waits_follows_the_frame_that_another_connection_has_begun() {
        let queue = |frames: [(FrameLane, &'static str); 2], written| {
            let mut queue = StreamSendQueue::default();
            for (lane, frame) in frames {
                assert!(queue.push((lane, frame.into(), None), 1 << 20));
            }
            assert_eq!(queue.advance(written), 0);
            queue
        };
        let mut waiting = queue([(FrameLane::Hello, "h"), (FrameLane::Usual, "b")], 3);

        waiting.follow(queue([(FrameLane::Usual, "begun"), (FrameLane::Usual, "a")], 7));

        let order: Vec<_> = waiting.frames.iter().map(|(_, frame, _)| frame.pieces()[0]).collect();
        assert_eq!(order, [&b"begun"[..], b"h", b"a", b"b"]);
        assert_eq!((waiting.written, waiting.advance(2)), (7, 1));
    }

    #[test]
    fn the_urgent_goes_behind_the_frame_that_has_begun_and_before_all_others() {
        let mut outgoing = StreamSendQueue::default();
        let push = |outgoing: &mut StreamSendQueue, lane, frame: &'static str| {
            assert!(outgoing.push((lane, frame.into(), None), 1 << 20));
        };
        push(&mut outgoing, FrameLane::Usual, "a");
        push(&mut outgoing, FrameLane::Usual, "b");
        assert_eq!(outgoing.advance(1), 0);

        for frame in ["x", "y"] {
            push(&mut outgoing, FrameLane::Urgent, frame);
        }
        push(&mut outgoing, FrameLane::Hello, "h");

        let order: Vec<_> = outgoing.frames.iter().map(|(_, frame, _)| frame.pieces()[0]).collect();
        assert_eq!(order, [b"a", b"h", b"x", b"y", b"b"]);
    }
}
