//! One contract, declared by two types.

use blastema::prelude::*;

/// Two types of one contract: on the wire they are the same.
mod twice {
    use super::*;

    #[derive(Clone, Debug, Event)]
    #[contract(name = "camera/image")]
    pub(super) struct Shared {
        pub(super) pixels: blastema::Blob,
    }

    #[derive(Clone, Debug, Event)]
    #[contract(name = "camera/image")]
    pub(super) struct Copied {
        pub(super) pixels: Vec<u8>,
    }
}

struct Viewer;

impl Component for Viewer {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<twice::Shared>();
    }
}

impl Handle<twice::Shared> for Viewer {
    async fn handle(&mut self, image: twice::Shared, _: &mut Context<Self>) {
        drop(image.pixels);
    }
}

struct Recorder;

impl Component for Recorder {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<twice::Copied>();
        ports.listen::<twice::Copied>();
    }
}

impl Handle<twice::Copied> for Recorder {
    async fn handle(&mut self, image: twice::Copied, _: &mut Context<Self>) {
        drop(image.pixels);
    }
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn two_types_of_one_contract_are_told_with_both_and_with_where_each_is_named() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let both = Node::builder("m")
                .child(ChildSpec::new("viewer", || Viewer))
                .child(ChildSpec::new("recorder", || Recorder));

            let told = both.start().await.expect_err("a topic carries one type").to_string();

            for part in [
                "recorder cannot listen",
                "the topic \"camera/image\" carries virtual::scenarios::two_types::twice::Shared (by ",
                "and virtual::scenarios::two_types::twice::Copied (by ",
                "share one of them",
            ] {
                assert!(told.contains(part), "{part} is missing in {told}");
            }
            assert_eq!(told.matches(&format!("{}:", file!())).count(), 2, "{told}");

            let recorder = Node::builder("m").child(ChildSpec::new("recorder", || Recorder));
            let node = recorder.start().await.expect("one type alone");
            let told =
                node.publisher::<twice::Shared>("camera/image").expect_err("another").to_string();
            assert!(
                told.contains("carries virtual::scenarios::two_types::twice::Copied (by "),
                "{told}"
            );
            let told = node.sender::<twice::Shared>("recorder").expect_err("another").to_string();
            let types = "recorder takes virtual::scenarios::two_types::twice::Copied, and not virtual::scenarios::two_types::twice::Shared";
            assert!(told.contains(types), "{told}");
            node.shutdown().await;
        });
    }
}
