//! What a medium must be able to do, for a [`FrameTransport`](crate::FrameTransport) to do the
//! rest.

use crate::reach::Reach;
use blastema_contract::transport::MediumAddress;
use blastema_core::medium::lane::FrameLane;
use bytes::Bytes;
use std::io;
use std::task::{Context, Poll};

/// A medium that moves whole frames: all that is to be written for one more kind of it.
///
/// Queueing, counting, opening again with back-off, recovery after a panic, and the contract with
/// links are done by [`FrameTransport`](crate::FrameTransport). Nothing here may block: it is
/// polled on a thread that others share, within a tokio runtime.
pub trait FrameMedium: Send + 'static {
    /// How people call it, such as `serial /dev/ttyUSB0`; it stands at the beginning of errors.
    fn name(&self) -> String;

    /// How far its frames travel. A node without keys refuses to start with a medium that leaves
    /// the computer, which is the default, unless its network is declared insecure.
    fn reach(&self) -> Reach {
        Reach::Network
    }

    /// How much may wait for it.
    fn queue(&self) -> QueueLimits {
        QueueLimits::default()
    }

    /// How much it carries in a second, both ways together, where that is little: hellos are said
    /// less often then, and it is dearer to use than others.
    fn bytes_per_second(&self) -> Option<u64> {
        None
    }

    /// Opens it, or opens it again after it was lost or closed.
    ///
    /// # Errors
    /// It cannot be opened at present; the text says what the user may do. It is tried again, 20 ms
    /// later at first and at last every second.
    fn open(&mut self) -> io::Result<OpenedMedium>;

    /// Ready when what was opened can be used. Until then it is not said to be open, and nothing is
    /// sent or taken.
    ///
    /// # Errors
    /// It cannot be used; as with [`open`](FrameMedium::open).
    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    /// Whether an address can be one of this medium. A frame to another is refused.
    fn knows(&self, address: &MediumAddress) -> bool;

    /// Ready when the medium can begin with another frame. Until then it is not yet chosen, so that
    /// an urgent one may still go before those that wait.
    fn poll_capacity(&mut self, _: &mut Context<'_>) -> Poll<()> {
        Poll::Ready(())
    }

    /// Gives a frame to the medium. Where the answer is `Pending`, it is called with the same frame
    /// again, until it is ready or the medium is closed. The lane is for a medium that holds frames
    /// back itself: those of an earlier one overtake those of a later one.
    ///
    /// # Errors
    /// The medium is lost: it is closed, and opened again.
    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        to: &MediumAddress,
        frame: &Bytes,
        lane: FrameLane,
    ) -> Poll<io::Result<SendResult>>;

    /// Takes what the medium has. It is also the place to look after whatever must go on by itself.
    ///
    /// # Errors
    /// The medium is lost: it is closed, and opened again.
    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>>;

    /// Lets go of it. It may be opened again, and begins from nothing then.
    fn close(&mut self);
}

/// A medium has been opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenedMedium {
    /// Our own address on it.
    pub local: MediumAddress,
    /// The largest frame, in bytes.
    pub mtu: usize,
}

/// What became of a frame that was to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SendResult {
    /// The medium has it.
    Sent,
    /// It is lost, because no peer can be reached at its address at present.
    Dropped,
}

/// What a medium has to tell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MediumEvent {
    /// A frame has arrived.
    Frame {
        /// The address of the sender.
        from: MediumAddress,
        /// The whole frame.
        frame: Bytes,
    },
    /// Something that is no frame: noise on a line, a foreign protocol.
    Refused,
    /// So many frames that the medium had taken are lost, and will not reach whom they were for.
    Lost {
        /// The number of lost frames.
        frames: u64,
    },
    /// Another node sends under this node's address on the medium: a user must know.
    Clash {
        /// Which address, and what helps.
        text: String,
    },
    /// A connection with this peer is gone (media with connections only).
    PeerLost {
        /// The peer's address on the medium.
        peer: MediumAddress,
    },
}

/// How much may wait for a medium, of urgent frames and of usual ones each; beyond, frames are
/// dropped and counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueLimits {
    /// So many frames.
    pub frames: usize,
    /// So many bytes in them.
    pub bytes: usize,
}

impl Default for QueueLimits {
    /// Some ten milliseconds of a fast medium: what a stall of the medium may last before frames
    /// are lost.
    fn default() -> Self {
        QueueLimits { frames: 256, bytes: 1 << 20 }
    }
}
