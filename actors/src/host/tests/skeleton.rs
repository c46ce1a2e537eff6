//! Names, and the way in from outside the process.

use super::{Add, Boom, GRANT, Note, Stage, acc, boom, logged};
use crate::registry::{MessageMetadata, ReplyTo};
use crate::{
    Blob, ChildSpec, Component, Context, DeadReason, DeliveryError, Handle, Incarnation,
    ObjectName, Ports, Request, SpecError, WhenFull,
};
use blastema_core::contract::codec;
use blastema_core::{Contract, ContractIdentity, GatherBuffer, MessageId, NodeName};
use blastema_doubles::settle;
use bytes::Bytes;
use std::sync::{Arc, Mutex};

fn encoded<M: Contract>(message: &M) -> Bytes {
    let mut bytes = Vec::new();
    codec::encode(message, &mut bytes).unwrap();
    bytes.into()
}

fn name(text: &str) -> ObjectName {
    ObjectName::new(text).unwrap()
}

type ReplyPlace = Arc<Mutex<Option<Result<GatherBuffer, DeliveryError>>>>;

/// A place for one reply, and the callback that fills it.
fn reply() -> (ReplyPlace, ReplyTo) {
    let place = Arc::new(Mutex::new(None));
    let kept = place.clone();
    (place, Box::new(move |result| *kept.lock().unwrap() = Some(result)))
}

fn metadata(id: Option<MessageId>) -> MessageMetadata {
    MessageMetadata { id, ..MessageMetadata::default() }
}

const ID: Option<MessageId> = Some(MessageId { sender: 9, sequence: 1 });

#[blastema_macros::test(crate = "blastema_doubles")]
async fn bytes_from_outside_are_served_and_the_reply_goes_back_as_bytes() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (mut child, _) = stage.start(spec).await;
    let registry = &stage.environment.registry;
    let (identity, add) = registry.skeleton(&name("acc"), Add::NAME).unwrap();
    assert_eq!(identity.fingerprint, ContractIdentity::of::<Add>().fingerprint);

    let (place, reply_to) = reply();
    add.deliver(&encoded(&Add(4)), metadata(ID), Some(reply_to)).unwrap();
    settle().await;
    let bytes = place.lock().unwrap().take().unwrap().unwrap();
    assert_eq!(codec::decode_reply::<Add>(&bytes.into_bytes()).unwrap(), 4);

    let (_, note) = registry.skeleton(&name("acc"), Note::NAME).unwrap();
    note.deliver(&encoded(&Note(7)), metadata(None), None).unwrap();
    settle().await;
    assert_eq!(logged(&log), [7]);

    let (_, kill) = registry.skeleton(&name("acc"), Boom::NAME).unwrap();
    for incarnation in 1..=3 {
        child.order(GRANT);
        let (place, reply_to) = reply();
        kill.deliver(&encoded(&boom("x")), metadata(ID), Some(reply_to)).unwrap();
        settle().await;
        let why = place.lock().unwrap().take().unwrap().unwrap_err();
        assert_eq!(why, DeliveryError::PeerDied { incarnation: Incarnation(incarnation) });
    }
    let (place, reply_to) = reply();
    let refused = kill.deliver(&encoded(&boom("x")), metadata(ID), Some(reply_to)).unwrap_err();
    assert_eq!(refused, DeliveryError::Quarantined { kills: 3 });
    assert_eq!(place.lock().unwrap().take(), Some(Err(refused)));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn bytes_that_are_no_message_are_refused_and_counted() {
    let stage = Stage::new();
    let (_child, acc) = stage.start(acc("acc").0).await;
    let registry = &stage.environment.registry;
    let (_, add) = registry.skeleton(&name("acc"), Add::NAME).unwrap();

    let (place, reply_to) = reply();
    let why =
        add.deliver(&Bytes::from_static(b"no number"), metadata(ID), Some(reply_to)).unwrap_err();

    assert!(matches!(why, DeliveryError::Undecodable { .. }), "{why}");
    assert_eq!(place.lock().unwrap().take(), Some(Err(why)));
    assert_eq!(stage.environment.dead_letters.total(), 1);
    assert!(registry.skeleton(acc.name(), "no such contract").is_err());
    assert!(registry.skeleton(&name("absent"), Add::NAME).is_err());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_message_from_outside_may_wait_for_capacity_and_is_counted() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (_child, acc) = stage.start(spec.queue(1, WhenFull::Refuse)).await;
    let (_, note) = stage.environment.registry.skeleton(&name("acc"), Note::NAME).unwrap();

    note.deliver(&encoded(&Note(1)), metadata(None), None).unwrap();
    let why = note.deliver(&encoded(&Note(2)), metadata(None), None).unwrap_err();
    assert_eq!(why, DeliveryError::Full);
    note.space().unwrap().await;
    note.deliver(&encoded(&Note(2)), metadata(None), None).unwrap();
    let why = note.deliver(&encoded(&Note(3)), metadata(None), None).unwrap_err();
    assert_eq!(stage.environment.dead_letters.total(), 0);
    note.record_dead_letter(&why);
    settle().await;

    assert_eq!(logged(&log), [1, 2]);
    assert_eq!(stage.environment.dead_letters.count(acc.name(), DeadReason::Full), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_name_is_given_once_and_freed_with_its_holder() {
    let stage = Stage::new();
    let (first, _) = stage.add(acc("acc").0);
    let taken = acc("acc").0.into_child(&stage.environment).err().unwrap();
    assert!(matches!(taken[..], [SpecError::Taken(_)]), "{taken:?}");
    let wrong = acc("no name").0.into_child(&stage.environment).err().unwrap();
    assert!(matches!(wrong[..], [SpecError::Name(_)]), "{wrong:?}");
    let wrong = acc("other").0.rate_hz(0.0).into_child(&stage.environment).err().unwrap();
    assert!(wrong[0].to_string().contains("rate_hz of other is 0"), "{wrong:?}");

    drop(first);

    stage.add(acc("acc").0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_looks_for_what_is_not_there_is_told_what_is() {
    #[derive(Request)]
    #[contract(reply = u64)]
    struct Missing;
    mod other {
        use crate::Request;
        #[derive(Request)]
        #[contract(reply = u64, name = "Add")]
        pub(super) struct Add {
            pub(super) _much: f32,
        }
    }

    let stage = Stage::new();
    let (_child, _) = stage.add(acc("acc").0);
    let registry = &stage.environment.registry;
    registry.set_node(NodeName::new("here").unwrap());

    assert!(registry.sender::<Add>("acc").is_ok());
    assert!(registry.sender::<Add>("here:acc").is_ok());
    for unknown in ["absent", "no name", ":"] {
        let why = registry.sender::<Add>(unknown).unwrap_err();
        assert_eq!(why, DeliveryError::Unknown { name: unknown.into() });
    }
    for (misspelt, nearest) in
        [("acx", "acc"), ("here:acx", "acc"), ("Acc", "acc"), ("there:acc", "here:acc")]
    {
        let why = registry.sender::<Add>(misspelt).unwrap_err();
        let (name, nearest) = (misspelt.into(), nearest.into());
        assert_eq!(why, DeliveryError::Misspelt { name, nearest });
    }
    let why = registry.sender::<Missing>("acc").unwrap_err();
    let DeliveryError::NotServed { object, contract, served } = why else { panic!("{why}") };
    assert_eq!((&*object, &*contract), ("acc", Missing::NAME));
    assert!(served.iter().any(|name| name == Add::NAME), "{served:?}");
    if other::Add::NAME == Add::NAME {
        let why = registry.sender::<other::Add>("acc").unwrap_err();
        assert!(matches!(why, DeliveryError::ContractDiffers { .. }), "{why}");
    }
    assert_eq!(registry.objects().len(), 1);
    assert_eq!(registry.objects()[0].1.len(), 4);
}

/// Asks for a picture.
#[derive(Clone, Debug, Request)]
#[contract(reply = Blob)]
struct Look;

struct Camera(Blob);

impl Component for Camera {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Look>();
    }
}
impl Handle<Look> for Camera {
    async fn handle(&mut self, _: Look, _: &mut Context<Self>) -> Blob {
        self.0.clone()
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_large_blob_is_not_copied_into_the_reply_that_goes_to_another_node() {
    let stage = Stage::new();
    let picture = Blob::from(vec![3; 10_000]);
    let shown = picture.clone();
    let spec = ChildSpec::new("camera", move || Camera(shown.clone()));
    let (_child, _) = stage.start(spec).await;
    let (_, look) = stage.environment.registry.skeleton(&name("camera"), Look::NAME).unwrap();

    let (place, reply_to) = reply();
    look.deliver(&encoded(&Look), metadata(None), Some(reply_to)).unwrap();
    settle().await;

    let parcel = place.lock().unwrap().take().unwrap().unwrap();
    assert!(parcel.pieces().iter().any(|piece| piece.as_ptr() == picture.as_ptr()));
    assert_eq!(codec::decode_reply::<Look>(&parcel.into_bytes()), Ok(picture));
}
