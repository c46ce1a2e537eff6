//! Objects of other nodes, reached with the same code as those of this one.

use super::skeleton::metadata;
use super::{Add, Boom, Note, Stage, acc, boom, logged};
use crate::registry::remote::{OutgoingRequest, RemoteStub, StubFactory};
use crate::{DeliveryError, Event, Incarnation};
use blastema_core::contract::codec;
use blastema_core::{Blob, ContractIdentity, GatherBuffer, NodeName, ObjectAddress};
use blastema_doubles::settle;
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};

/// Another node that leads back to this one.
struct Mirror(crate::registry::Registry);
struct MirrorDoor(Arc<dyn crate::registry::Skeleton>);

impl StubFactory for Mirror {
    fn stub(&self, to: ObjectAddress, contract: ContractIdentity) -> Arc<dyn RemoteStub> {
        Arc::new(MirrorDoor(self.0.skeleton(&to.object, contract.name).unwrap().1))
    }

    fn is_reachable(&self, _: &NodeName) -> bool {
        true
    }

    fn opening(&self, _: &NodeName) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        Box::pin(std::future::pending())
    }
}
impl RemoteStub for MirrorDoor {
    fn send(
        &self,
        message: GatherBuffer,
        asked: Option<OutgoingRequest>,
    ) -> Result<(), DeliveryError> {
        let id = asked.as_ref().and_then(|asked| asked.id);
        self.0.deliver(&message.into_bytes(), metadata(id), asked.map(|asked| asked.reply_to))
    }
    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(std::future::ready(()))
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_object_of_another_node_is_asked_with_the_same_code() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (_child, _) = stage.start(spec).await;
    let registry = &stage.environment.registry;
    let mirror = Arc::new(Mirror(registry.clone()));
    registry.set_node(NodeName::new("here").unwrap());
    registry.connect(mirror);
    let add = registry.sender::<Add>("there:acc").unwrap();

    assert_eq!(add.ask(Add(2)).await, Ok(2));
    registry.sender::<Note>("there:acc").unwrap().deliver(Note(3)).await.unwrap();
    settle().await;
    assert_eq!(logged(&log), [3]);
    let died = registry.sender::<Boom>("there:acc").unwrap().ask(boom("x")).await.unwrap_err();
    assert_eq!(died.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
}

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
