//! What a link has carried so far, for display.

/// What a link has carried so far, in frames and bytes as the medium carries them, with their seal.
///
/// A handshake about keys belongs to no link and is not counted as sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkTraffic {
    /// Frames that were given to the medium for the neighbour.
    pub frames_sent: u64,
    /// The bytes of the sent frames.
    pub bytes_sent: u64,
    /// Frames that came from the neighbour; where frames are sealed, those that it has sealed.
    pub frames_received: u64,
    /// The bytes of the received frames.
    pub bytes_received: u64,
    /// Frames that were to go to the neighbour and were dropped: the link was not up, or no keys
    /// were agreed on. What the medium loses later is not known here; hellos measure it.
    pub frames_dropped: u64,
}
