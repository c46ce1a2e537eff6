//! What routers say, in parts where the medium's frames cannot carry it whole.

use crate::net::wire::WireError;
use crate::net::wire::frame::{FRAME_HEADER, Frame, RoutingFragment};
use bytes::{Bytes, BytesMut};

/// The most bytes that are put together: one advertisement with all neighbours, and what it takes
/// back, are 677, and of more a router makes several.
const WHOLE_MAX: usize = 1_024;
/// What a part's frame puts before it: which part it is.
const PART_HEADER: usize = FRAME_HEADER + 1;

/// The frames that carry this, none larger than `mtu`; 0 where that is not known yet.
pub(super) fn frames_of(bytes: Bytes, mtu: usize) -> Vec<Frame> {
    if mtu <= PART_HEADER || bytes.len() + FRAME_HEADER <= mtu {
        return vec![Frame::Routing(bytes)];
    }
    let capacity = mtu - PART_HEADER;
    let count = bytes.len().div_ceil(capacity);
    (0..count)
        .map(|index| {
            let part = bytes.slice(index * capacity..bytes.len().min((index + 1) * capacity));
            let (last, index) = (index + 1 == count, index as u8 & RoutingFragment::INDEX_MAX);
            Frame::RoutingPart(RoutingFragment { index, last, bytes: part })
        })
        .collect()
}

/// Puts parts together that come in their order. Where one is missing, the rest is worth nothing:
/// routers repeat what is not confirmed.
#[derive(Debug, Default)]
pub(super) struct RoutingReassembly {
    held: BytesMut,
    /// Which comes next.
    next: u8,
}

impl RoutingReassembly {
    /// Answers with the whole when it was the last.
    pub(super) fn handle(&mut self, part: &RoutingFragment) -> Result<Option<Bytes>, WireError> {
        if part.index == 0 {
            *self = RoutingReassembly::default();
        }
        if part.index != self.next {
            *self = RoutingReassembly::default();
            return Err(WireError::Truncated);
        }
        if self.held.len() + part.bytes.len() > WHOLE_MAX {
            *self = RoutingReassembly::default();
            return Err(WireError::TooLarge { what: "what a router says" });
        }
        self.held.extend_from_slice(&part.bytes);
        self.next = part.index.saturating_add(1);
        Ok(part.last.then(|| std::mem::take(self).held.freeze()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::NodeId;
    use crate::net::wire::advertisement::{
        Advertisement, AdvertisementId, Edge, NEIGHBOURS_MAX, RoutingMessage, SIGNATURE_LENGTH,
    };
    use crate::{Incarnation, NodeName};

    fn parts_of(length: usize, mtu: usize) -> Vec<RoutingFragment> {
        let whole: Bytes = (0..length).map(|n| n as u8).collect();
        let part = |frame| match frame {
            Frame::RoutingPart(part) => part,
            other => panic!("{other:?}"),
        };
        frames_of(whole, mtu).into_iter().map(part).collect()
    }

    #[test]
    fn what_fits_goes_whole_and_what_does_not_comes_back_from_frames_that_fit() {
        for length in [0, 1, 126, 1_000] {
            let whole: Bytes = (0..length).map(|n| n as u8).collect();
            for mtu in [0, length + 2, 65_535] {
                assert_eq!(frames_of(whole.clone(), mtu), [Frame::Routing(whole.clone())]);
            }
        }
        for length in [127, 250, 251, 677, WHOLE_MAX] {
            let mut parts = RoutingReassembly::default();
            let all = parts_of(length, 128);
            let (last, others) = all.split_last().unwrap();
            for part in others {
                assert!(Frame::RoutingPart(part.clone()).encode().len() <= 128);
                assert_eq!(parts.handle(part), Ok(None));
            }
            let whole: Bytes = (0..length).map(|n| n as u8).collect();
            assert_eq!(parts.handle(last), Ok(Some(whole)));
        }
    }

    #[test]
    fn the_most_that_a_router_says_of_a_node_at_once_is_put_together() {
        let edge = Edge { to: NodeId(1), incarnation: 1, cost: 1, mtu: 96 };
        let advertisement = Advertisement {
            id: AdvertisementId { origin: NodeId(2), sequence: 1 },
            incarnation: Incarnation(1),
            node: NodeName::new(&"n".repeat(32)).unwrap(),
            edges: vec![edge; NEIGHBOURS_MAX],
            signature: Some([1; SIGNATURE_LENGTH]),
        };
        let most = RoutingMessage::Announce(vec![advertisement]).encode();
        assert_eq!(most.len(), 695);

        let mut parts = RoutingReassembly::default();
        let mut frames = frames_of(most.clone(), 96).into_iter();
        let whole = frames.find_map(|frame| match frame {
            Frame::RoutingPart(part) => parts.handle(&part).unwrap(),
            other => panic!("{other:?}"),
        });
        assert_eq!(whole, Some(most));
    }

    #[test]
    fn a_missing_part_costs_the_whole_and_nothing_of_the_next() {
        let all = parts_of(300, 128);
        let mut parts = RoutingReassembly::default();

        assert_eq!(parts.handle(&all[0]), Ok(None));
        assert_eq!(parts.handle(&all[2]), Err(WireError::Truncated));
        assert_eq!(parts.handle(&all[1]), Err(WireError::Truncated));

        assert_eq!(parts.handle(&all[0]), Ok(None));
        assert_eq!(parts.handle(&all[0]), Ok(None));
        assert_eq!(parts.handle(&all[1]), Ok(None));
        assert_eq!(parts.handle(&all[2]).unwrap().unwrap().len(), 300);
    }

    #[test]
    fn what_never_ends_is_refused() {
        let mut parts = RoutingReassembly::default();
        let refused = (0..=RoutingFragment::INDEX_MAX).find_map(|index| {
            parts.handle(&RoutingFragment { index, last: false, bytes: vec![0; 100].into() }).err()
        });
        assert_eq!(refused, Some(WireError::TooLarge { what: "what a router says" }));
        assert!(parts.held.is_empty());
    }
}
