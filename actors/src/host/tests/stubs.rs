//! What is sent to objects of other nodes.

use super::Stage;
use crate::registry::remote::{OutgoingRequest, RemoteStub, StubFactory};
use crate::{DeliveryError, Event};
use blastema_core::contract::codec;
use blastema_core::{Blob, ContractIdentity, GatherBuffer, NodeName, ObjectAddress};
use std::pin::Pin;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};

/// Much that a vector holds.
#[derive(Clone, Debug, PartialEq, Event)]
struct Image {
    number: u32,
    pixels: Blob,
}

/// A way out that refuses the first message, and keeps the next.
#[derive(Clone, Default)]
struct Narrow {
    refused: Arc<AtomicBool>,
    taken: Arc<Mutex<Option<GatherBuffer>>>,
}

impl StubFactory for Narrow {
    fn stub(&self, _: ObjectAddress, _: ContractIdentity) -> Arc<dyn RemoteStub> {
        Arc::new(self.clone())
    }

    fn is_reachable(&self, _: &NodeName) -> bool {
        true
    }

    fn opening(&self, _: &NodeName) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        Box::pin(std::future::pending())
    }
}
impl RemoteStub for Narrow {
    fn send(&self, message: GatherBuffer, _: Option<OutgoingRequest>) -> Result<(), DeliveryError> {
        if !self.refused.swap(true, Relaxed) {
            return Err(DeliveryError::Full);
        }
        *self.taken.lock().unwrap() = Some(message);
        Ok(())
    }
    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(std::future::ready(()))
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_large_blob_is_sent_and_returned_without_a_copy() {
    let registry = Stage::new().environment.registry.clone();
    let narrow = Narrow::default();
    registry.set_node(NodeName::new("here").unwrap());
    registry.connect(Arc::new(narrow.clone()));
    let images = registry.sender::<Image>("there:screen").unwrap();
    let image = Image { number: 7, pixels: vec![9; 10_000].into() };
    let (place, copy) = (image.pixels.as_ptr(), image.clone());

    let refused = images.tell(image).unwrap_err();
    assert_eq!((refused.kind, &refused.message), (DeliveryError::Full, &copy));
    assert_eq!(refused.message.pixels.as_ptr(), place);

    images.tell(refused.message).unwrap();
    let taken = narrow.taken.lock().unwrap().take().unwrap();
    assert!(taken.pieces().iter().any(|piece| piece.as_ptr() == place));
    assert_eq!(codec::decode::<Image>(&taken.into_bytes()), Ok(copy));
}
