//! One contract, declared by two types.

use blastema::prelude::*;
use blastema_tests::{Part, part};

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

fn viewer() -> ChildSpec<Part<(), twice::Shared>> {
    let viewer = part("viewer", (), |_, image: twice::Shared, _| drop(image.pixels));
    viewer.with_ports(|ports| {
        ports.listen::<twice::Shared>();
    })
}

fn recorder() -> ChildSpec<Part<(), twice::Copied>> {
    let recorder = part("recorder", (), |_, image: twice::Copied, _| drop(image.pixels));
    recorder.with_ports(|ports| {
        ports.accept::<twice::Copied>();
        ports.listen::<twice::Copied>();
    })
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn two_types_of_one_contract_are_told_with_both_and_with_where_each_is_named() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let both = Node::builder("m").child(viewer()).child(recorder());

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

            let alone = Node::builder("m").child(recorder());
            let node = alone.start().await.expect("one type alone");
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
