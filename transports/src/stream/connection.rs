//! A connection on which both sides have said where they listen.

use super::framing::{announced, capacity, decode};
use super::outgoing::StreamSendQueue;
use bytes::{BufMut, Bytes, BytesMut};
use std::pin::pin;
use std::task::{self, Poll};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite};

/// A stream, and what was read of a frame that is not whole.
pub(super) struct Connection<S> {
    /// Under which number the receiver knew it, when the other end made it.
    pub(super) number: Option<u32>,
    stream: S,
    buffer: BytesMut,
}

/// What came of reading once.
pub(super) enum ReadStep {
    /// One whole frame.
    Frame(Bytes),
    /// A part of one.
    Part,
    /// Nothing has arrived. The task is woken when something does.
    Nothing,
}

/// Why a turn of reading ended.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum ReadEnd {
    /// There is nothing to be read. The task is woken when there is.
    Done,
    /// The budget is used up: the rest is for the next turn.
    Budget,
    /// The upstream is full. The task is woken when it is not.
    Full,
}

/// Why a connection is no more.
#[derive(Clone, Copy)]
pub(super) enum DisconnectReason {
    /// The other side closed it, or the network did.
    Lost,
    /// The other side sent what is no frame, or did not prove who it is.
    Refused,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    pub(super) fn new(stream: S, number: Option<u32>) -> Self {
        Connection { number, stream, buffer: BytesMut::new() }
    }

    /// How long the frame is that comes next, when its header is there.
    pub(super) fn announced(&self) -> Option<usize> {
        announced(&self.buffer)
    }

    /// Reads a frame of `limit` bytes at most, or a part of one.
    pub(super) fn read(
        &mut self,
        limit: usize,
        task: &mut task::Context<'_>,
    ) -> Result<ReadStep, DisconnectReason> {
        let Connection { stream, buffer, .. } = self;
        if let Some(frame) = decode(buffer, limit).map_err(|_| DisconnectReason::Refused)? {
            return Ok(ReadStep::Frame(frame));
        }
        let capacity = capacity(buffer, limit);
        buffer.reserve(capacity);
        let mut part = buffer.limit(capacity);
        // Nothing is lost with the future: it holds no bytes.
        match pin!(stream.read_buf(&mut part)).poll(task) {
            Poll::Ready(Ok(0) | Err(_)) => Err(DisconnectReason::Lost),
            Poll::Ready(Ok(_)) => Ok(ReadStep::Part),
            Poll::Pending => Ok(ReadStep::Nothing),
        }
    }

    /// Writes what waits, as far as the kernel takes it; the answer is how many frames went out.
    pub(super) fn write(
        &mut self,
        waiting: &mut StreamSendQueue,
        task: &mut task::Context<'_>,
    ) -> Result<u64, DisconnectReason> {
        waiting.write(&mut self.stream, task).map_err(|_| DisconnectReason::Lost)
    }
}
