//! The invariants of ARCHITECTURE.md, held as tests.
//!
//! Each rule is a function from the tree of files to its breaches. The first half applies the rules
//! to this project; the second half shows each of them a small tree that breaks it, since a rule
//! that cannot fail proves nothing.

mod imports;
mod names;
mod packages;
mod pages;
mod sources;
mod tree;

use std::sync::LazyLock;
use tree::{Breach, Tree};

static PROJECT: LazyLock<Tree> = LazyLock::new(Tree::of_project);

/// Fails with every breach and with what to do about it.
#[track_caller]
fn holds(rule: fn(&Tree) -> Vec<Breach>, cure: &str) {
    let mut breaches = rule(&PROJECT);
    breaches.sort();
    breaches.dedup();
    let lines: Vec<String> =
        breaches.iter().map(|b| format!("{}:{}: {}", b.path, b.line, b.what)).collect();
    assert!(lines.is_empty(), "\n{}\nWhat to do: {cure}\n", lines.join("\n"));
}

#[test]
fn arrows_between_packages_point_down_only() {
    holds(
        packages::arrows,
        "move what is needed further down, or turn the call into a message of core/contract; a new \
         package gets its place in the map of ARCHITECTURE.md and in PLACES of packages.rs",
    );
}

#[test]
fn imports_within_actors_point_down_only() {
    holds(
        imports::layers,
        "move what is needed to the lowest layer that needs it, or turn the import: a trait below, \
         an `impl` block above, an extension of the environment; a new folder gets its place in \
         LAYERS of imports.rs",
    );
}

#[test]
fn files_of_a_folder_import_each_other_in_one_direction() {
    holds(imports::circles, "move what both need to a file of its own");
}

#[test]
fn files_name_what_they_take_from_their_parent() {
    holds(imports::globs_of_parents, "write out the names");
}

#[test]
fn the_core_stays_nearly_bare_and_outside_crates_are_known_where_they_belong() {
    holds(
        packages::outsiders,
        "reach the crate through the package that knows it; the core takes only what it is given",
    );
}

#[test]
fn versions_stand_in_the_root_manifest_only() {
    holds(
        packages::inheritance,
        "write the version into [workspace.dependencies] and `name.workspace = true` here",
    );
}

#[test]
fn every_package_takes_the_lints_that_forbid_unsafe_code() {
    holds(packages::lints, "add `[lints]` and `workspace = true` to the manifest");
}

#[test]
fn the_core_knows_no_actor_no_runtime_no_system_and_no_order_of_chance() {
    holds(
        sources::purity,
        "let the machine say what it wants done and be given the time; use BTreeMap and BTreeSet, \
         which iterate in a fixed order",
    );
}

#[test]
fn the_contract_names_messages_and_does_nothing() {
    holds(sources::contract_purity, "move the deed into the object that carries it out");
}

#[test]
fn only_the_platform_reads_a_clock() {
    holds(
        sources::clock,
        "take an Instant as an argument, or ask actors/src/platform.rs, whose clock tests can pause",
    );
}

#[test]
fn only_the_codec_knows_bincode() {
    holds(sources::codec, "encode and decode through core/src/contract/codec.rs");
}

#[test]
fn only_noise_knows_the_libraries_of_the_handshake() {
    holds(
        sources::handshake_libraries,
        "ask core/src/net/seal/noise.rs, or any SealCrypto, for what they do",
    );
}

#[test]
fn nothing_is_unsafe_unfinished_silenced_or_skipped() {
    holds(sources::unfinished, "finish it, delete it, or make the test pass");
}

#[test]
fn what_can_fail_says_why_instead_of_unwrapping() {
    holds(
        sources::unwrapping,
        "return an error, or `expect` the fact that makes the failure impossible",
    );
}

#[test]
fn every_queue_has_a_bound() {
    holds(
        sources::unbounded_queues,
        "give the queue a capacity, a reason for it, and say what full means",
    );
}

#[test]
fn no_handler_stops_its_mailbox() {
    holds(sources::mailbox_stops, "keep the state of the wait in the actor, or spawn a future");
}

#[test]
fn tests_do_not_sleep_for_real() {
    holds(sources::sleeping_tests, "advance the paused clock, or wait for the event itself");
}

#[test]
fn no_file_is_dead() {
    holds(sources::dead_files, "declare it with `mod`, or delete it");
}

#[test]
fn files_stay_below_six_hundred_lines_without_their_tests() {
    holds(sources::long_files, "split the file by concept, each part named by its noun");
}

#[test]
fn every_file_and_folder_begins_with_its_story() {
    holds(sources::stories, "begin with `//!`: what it is, and what it deliberately does not do");
}

#[test]
fn names_say_what_is_named() {
    holds(sources::empty_names, "name it by the noun that it defines");
}

#[test]
fn a_type_that_other_files_can_name_has_a_name_of_its_own() {
    holds(
        names::of_types,
        "name one of them by the field's term for what it is; the machine or the message of the \
         glossary keeps the name",
    );
}

#[test]
fn actix_stays_out_of_the_facade() {
    holds(
        sources::facade,
        "hide it behind a type of our own, make it pub(crate), or move it to actors/src/plain",
    );
}

#[test]
fn tests_on_real_threads_take_turns() {
    holds(sources::turns, "begin it with `let _turn = blastema_doubles::turn();`");
}

#[test]
fn objects_know_each_other_by_contract() {
    holds(sources::acquaintance, "hold a Recipient of the message instead of the other's address");
}

#[test]
fn the_glossary_explains_the_whole_vocabulary() {
    holds(pages::glossary, "add the term to actors/src/manual/glossary.md");
}

#[test]
fn the_manual_says_what_every_error_means() {
    holds(pages::errors, "say in actors/src/manual/sending.md what it means and what to do");
}

#[test]
fn the_map_shows_every_package() {
    holds(
        pages::map,
        "add the row `folder/` | `package` | what it holds to the map of ARCHITECTURE.md",
    );
}

#[test]
fn pages_are_wrapped() {
    holds(pages::width, "wrap the paragraph at 120 columns");
}

#[test]
fn sentences_name_who_acts() {
    holds(
        pages::subjects,
        "name the part of the system that acts: the peer, the sender, the session",
    );
}

mod a_rule_can_fail {
    use super::*;

    /// The paths and lines at which the rule finds the tree of these texts wanting.
    #[track_caller]
    fn check(rule: fn(&Tree) -> Vec<Breach>, texts: &[(&str, &str)], expected: &[(&str, usize)]) {
        let mut found: Vec<(String, usize)> =
            rule(&Tree::of_texts(texts)).into_iter().map(|b| (b.path, b.line)).collect();
        found.sort();
        found.dedup();
        let expected: Vec<(String, usize)> =
            expected.iter().map(|&(path, line)| (path.into(), line)).collect();
        assert_eq!(found, expected);
    }

    const CORE: &str = "[package]\nname = \"blastema-core\"\n[dependencies]\n";

    #[test]
    fn when_a_source_or_a_page_leaves_open_who_acts() {
        let texts = [
            ("README.md", "The caller waits.\nNobody asks."),
            ("core/src/lib.rs", "fn nobody_asks() {}\n// Whoever asks, waits."),
            ("core/data.txt", "nobody"),
        ];
        check(pages::subjects, &texts, &[("README.md", 2), ("core/src/lib.rs", 2)]);
    }

    #[test]
    fn when_a_line_of_a_page_is_too_wide() {
        let wide = format!("| {0} |\n{0}\n{0}ä\n", "ä".repeat(120));
        check(pages::width, &[("docs/page.md", &wide)], &[("docs/page.md", 3)]);
    }

    #[test]
    fn when_a_layer_imports_one_above_it_also_by_another_name() {
        let texts = [
            ("actors/src/lib.rs", "mod arbiter; mod host; mod odd;"),
            ("actors/src/arbiter.rs", "use crate::{host::A, sync::B};\nfn a() { crate::odd::b() }"),
            ("actors/src/host.rs", "mod spec;\npub(crate) use spec::A;\nuse crate::arbiter::C;"),
            ("actors/src/host/spec.rs", "pub(crate) struct A;"),
            ("actors/src/odd.rs", "use crate::arbiter::C;\n#[cfg(test)]\nuse crate::host::A;"),
        ];
        let arbiter = "actors/src/arbiter.rs";
        let expected = [(arbiter, 1), (arbiter, 2), ("actors/src/odd.rs", 1)];
        check(imports::layers, &texts, &expected);
    }

    #[test]
    fn when_files_of_a_folder_import_each_other() {
        let texts = [
            ("core/src/lib.rs", "mod a; mod b; mod c;\npub use b::B;"),
            ("core/src/a.rs", "use crate::B;\nuse super::c::C;"),
            ("core/src/b.rs", "use crate::a::A;"),
            ("core/src/c.rs", "struct C;"),
        ];
        check(imports::circles, &texts, &[("core/src/a.rs", 1), ("core/src/b.rs", 1)]);
    }

    #[test]
    fn when_a_file_takes_all_of_its_parent() {
        let text = "use super::*;\n#[cfg(test)]\nmod tests {\n use super::*;\n}";
        let texts = [("core/src/lib.rs", "mod a;"), ("core/src/a.rs", text)];
        check(imports::globs_of_parents, &texts, &[("core/src/a.rs", 1)]);
    }

    #[test]
    fn when_an_arrow_points_up() {
        let up = format!("{CORE}serde.workspace = true\nblastema.workspace = true\n");
        check(packages::arrows, &[("core/Cargo.toml", &up)], &[("core/Cargo.toml", 5)]);
    }

    #[test]
    fn when_an_arrow_points_sideways() {
        let aside = "[package]\nname = \"blastema-doubles\"\n[dev-dependencies]\nblastema-transports = { workspace = true }\n";
        check(
            packages::arrows,
            &[("core/doubles/Cargo.toml", aside)],
            &[("core/doubles/Cargo.toml", 4)],
        );
    }

    #[test]
    fn when_an_arrow_hides_in_a_table_of_its_own() {
        let table = "[package]\nname = \"blastema-core\"\n[dependencies.blastema-contract]\nworkspace = true\n";
        check(packages::arrows, &[("core/Cargo.toml", table)], &[("core/Cargo.toml", 3)]);
        let of_target = "[package]\nname = \"blastema-core\"\n[target.'cfg(unix)'.dependencies]\nblastema-contract.workspace = true\n";
        check(packages::arrows, &[("core/Cargo.toml", of_target)], &[("core/Cargo.toml", 4)]);
    }

    #[test]
    fn when_a_package_has_no_place() {
        let stray = "[package]\nname = \"blastema-extras\"\n";
        check(packages::arrows, &[("extras/Cargo.toml", stray)], &[("extras/Cargo.toml", 1)]);
    }

    #[test]
    fn when_the_core_takes_a_runtime_or_a_chip_anything() {
        let heavy = format!("{CORE}tokio.workspace = true\n");
        check(packages::outsiders, &[("core/Cargo.toml", &heavy)], &[("core/Cargo.toml", 4)]);
        let chip = heavy.replace("-core", "-lite").replace("tokio", "bytes");
        let manifest = "core/lite/Cargo.toml";
        check(packages::outsiders, &[(manifest, &chip)], &[(manifest, 4)]);
    }

    #[test]
    fn when_a_version_stands_in_a_package() {
        let own = "[package]\nname = \"blastema\"\nversion.workspace = true\nedition.workspace = true\nrust-version.workspace = true\nlicense.workspace = true\n[dependencies]\nserde = \"1\"\nbytes = { workspace = true, features = [\"std\"] }\n";
        check(packages::inheritance, &[("actors/Cargo.toml", own)], &[("actors/Cargo.toml", 8)]);
    }

    #[test]
    fn when_a_package_goes_without_lints() {
        let root = "[workspace.lints.rust]\nunsafe_code = \"forbid\"\n";
        let texts = [("Cargo.toml", root), ("core/Cargo.toml", CORE)];
        check(packages::lints, &texts, &[("core/Cargo.toml", 1)]);
        let with = format!("{CORE}[lints]\nworkspace = true\n");
        let texts = [("Cargo.toml", "[workspace]\n"), ("core/Cargo.toml", with.as_str())];
        check(packages::lints, &texts, &[("Cargo.toml", 1)]);
    }

    #[test]
    fn when_a_machine_reads_the_time_even_in_a_test() {
        let reads = "//! A machine.\n// Instant::now in a comment, \"tokio\" in a text: harmless.\nfn f() -> &'static str { \"tokio\" }\nfn g() { std::time::Instant::now(); }\n#[cfg(test)]\nmod tests {\n    use std::collections::HashMap;\n}\n";
        let texts = [("core/src/lib.rs", reads)];
        check(sources::purity, &texts, &[("core/src/lib.rs", 4), ("core/src/lib.rs", 7)]);
    }

    #[test]
    fn when_the_contract_opens_a_socket() {
        let texts = [("core/contract/src/lib.rs", "use std::net::{SocketAddr, UdpSocket};\n")];
        check(sources::contract_purity, &texts, &[("core/contract/src/lib.rs", 1)]);
    }

    #[test]
    fn when_another_file_reads_the_clock_but_not_when_its_tests_do() {
        let reads = "mod node;\nmod platform;\n";
        let node = "fn f() { tokio::time::Instant::now(); }\nfn g(start: T) { start.elapsed(); }\n#[cfg(test)]\nmod tests { fn f() { Instant::now(); } }\n";
        let texts = [
            ("actors/src/lib.rs", reads),
            ("actors/src/node.rs", node),
            ("actors/src/platform.rs", "fn now() { Instant::now(); }\n"),
        ];
        check(sources::clock, &texts, &[("actors/src/node.rs", 1), ("actors/src/node.rs", 2)]);
    }

    #[test]
    fn when_bincode_leaves_the_codec() {
        let texts = [
            ("core/src/lib.rs", "mod codec;\nuse bincode::config;\n"),
            ("core/src/contract/codec.rs", "use bincode::config;\n"),
        ];
        check(sources::codec, &texts, &[("core/src/lib.rs", 2)]);
    }

    #[test]
    fn when_a_library_of_the_handshake_leaves_its_file() {
        let texts = [
            ("core/src/lib.rs", "mod net;\nfn a() { snow::b() }\nuse x25519_dalek::PublicKey;\n"),
            ("core/src/net/mod.rs", "mod seal;\n"),
            ("core/src/net/seal/mod.rs", "mod noise;\n"),
            ("core/src/net/seal/noise.rs", "use snow::Builder;\nuse x25519_dalek::PublicKey;\n"),
        ];
        let outside = "core/src/lib.rs";
        check(sources::handshake_libraries, &texts, &[(outside, 2), (outside, 3)]);
    }

    #[test]
    fn when_something_is_unfinished() {
        let text = "fn a() { todo!() }\nfn b() { dbg!(1); }\n#[ignore = \"slow\"]\nfn c() {}\n#[allow(dead_code)]\nfn d() {}\n/// ```ignore\nfn e() { unsafe {} }\n";
        let lines = [1, 2, 3, 5, 7, 8].map(|line| ("actors/src/lib.rs", line));
        check(sources::unfinished, &[("actors/src/lib.rs", text)], &lines);
    }

    #[test]
    fn when_something_unwraps_but_not_in_a_test() {
        let text = "mod tests_of_it;\nfn a() { b().unwrap(); c().unwrap_or(1); }\n#[cfg(test)]\nmod tests { fn a() { b().unwrap(); } }\n#[cfg(test)]\nmod more;\n";
        let texts = [
            ("actors/src/lib.rs", text),
            ("actors/src/more.rs", "fn a() { b().unwrap(); }\n"),
            ("actors/src/tests_of_it.rs", "fn a() { b().unwrap(); }\n"),
            ("actors/tests/behaviour.rs", "fn a() { b().unwrap(); }\n"),
        ];
        let expected = [("actors/src/lib.rs", 2), ("actors/src/tests_of_it.rs", 1)];
        check(sources::unwrapping, &texts, &expected);
    }

    #[test]
    fn when_a_queue_has_no_bound() {
        let text = "fn a() { tokio::sync::mpsc::unbounded_channel(); }\nfn b() { std::sync::mpsc::channel(); }\nfn c() { mpsc::channel(8); }\n";
        let texts = [("actors/src/lib.rs", text)];
        check(
            sources::unbounded_queues,
            &texts,
            &[("actors/src/lib.rs", 1), ("actors/src/lib.rs", 2)],
        );
    }

    #[test]
    fn when_a_handler_stops_its_mailbox() {
        let text = "fn a() { ctx.wait(b); }\nfn c() { child.wait(); }\n";
        check(sources::mailbox_stops, &[("actors/src/lib.rs", text)], &[("actors/src/lib.rs", 1)]);
    }

    #[test]
    fn when_a_test_sleeps_but_not_when_a_program_does() {
        let text = "fn a() { std::thread::sleep(b); }\n";
        let texts = [("tests/tests/demo.rs", text), ("actors/cli/src/main.rs", text)];
        check(sources::sleeping_tests, &texts, &[("tests/tests/demo.rs", 1)]);
    }

    #[test]
    fn when_a_file_is_dead_but_not_when_a_test_compiles_it() {
        let texts = [
            ("tests/Cargo.toml", "[package]\nname = \"blastema-tests\"\n"),
            ("tests/tests/derive.rs", "fn a() { t.compile_fail(\"tests/wrong/*.rs\"); }\n"),
            ("tests/tests/wrong/usize.rs", "this is not Rust\n"),
            ("core/src/lib.rs", "mod link;\nmod net;\n"),
            ("core/src/link.rs", ""),
            ("core/src/net/mod.rs", "mod frame;\n"),
            ("core/src/net/frame.rs", ""),
            ("core/src/net/left_over.rs", ""),
        ];
        check(sources::dead_files, &texts, &[("core/src/net/left_over.rs", 1)]);
    }

    #[test]
    fn when_a_file_is_too_long_but_not_when_its_tests_are() {
        let long = "fn a() {}\n".repeat(1_001);
        let tests = format!("fn a() {{}}\n#[cfg(test)]\nmod tests {{\n{long}}}\n");
        let texts = [("core/src/lib.rs", tests.as_str()), ("actors/src/lib.rs", long.as_str())];
        check(sources::long_files, &texts, &[("actors/src/lib.rs", 1_000)]);
    }

    #[test]
    fn when_a_file_tells_no_story() {
        let texts =
            [("core/src/lib.rs", "//! The core.\nmod net;\n"), ("core/src/net/mod.rs", "\n")];
        check(sources::stories, &texts, &[("core/src/net/mod.rs", 1)]);
    }

    #[test]
    fn when_a_name_says_nothing() {
        let texts = [
            ("core/src/lib.rs", "mod time_utils;\nstruct LinkManager;\nstruct Misconduct;\n"),
            ("core/src/time_utils.rs", ""),
        ];
        let expected =
            [("core/src/lib.rs", 1), ("core/src/lib.rs", 2), ("core/src/time_utils.rs", 1)];
        check(sources::empty_names, &texts, &expected);
    }

    #[test]
    fn when_actix_shows_in_the_facade() {
        let text = "mod plain;\nuse actix::{Addr, Recipient as Door};\npub use actix::Actor;\npub fn a(b: Addr<C>) {}\nfn d(e: Addr<C>) {}\npub struct F { pub g: Door<H>, i: Door<H> }\nimpl F {\n    pub fn j(&self) -> actix::System { k() }\n    pub fn l(&self) -> u8 { actix::m() }\n}\n";
        let texts = [
            ("actors/src/lib.rs", text),
            ("actors/src/plain.rs", "pub fn a() -> actix::Recipient<B> { c() }\n"),
        ];
        let lines = [3, 4, 6, 8].map(|line| ("actors/src/lib.rs", line));
        check(sources::facade, &texts, &lines);
    }

    #[test]
    fn when_a_type_has_the_name_of_another_that_is_visible() {
        let a = "mod b;\npub(crate) struct State;\nenum Phase {}\nstruct Link;\nmod c { trait Mode {} }";
        let b = "type State = u8;\nstruct Phase;\npub struct Link;\n#[cfg(test)]\npub struct Mode;";
        let texts = [("core/src/lib.rs", a), ("core/src/b.rs", b)];
        check(names::of_types, &texts, &[("core/src/b.rs", 1), ("core/src/lib.rs", 2)]);
    }

    #[test]
    fn when_an_object_knows_another_by_its_type() {
        let texts = [(
            "transports/src/lib.rs",
            "struct A { b: Addr<Self>, c: Recipient<D> }\nstruct E { f: Addr<A> }\nimpl Actor for G {}\nstruct H { i: Addr<G> }\n",
        )];
        check(sources::acquaintance, &texts, &[("transports/src/lib.rs", 2)]);
    }

    #[test]
    fn when_a_test_on_real_threads_takes_no_turn() {
        let texts = [
            (
                "core/tests/real/main.rs",
                "#[test]\n#[a]\nfn b() { c(); }\n#[test]\nfn a_process_d() {}\n",
            ),
            (
                "core/src/lib.rs",
                "#[test]\nfn a() {}\nmod real {\n#[test]\nfn b() { let _turn = c(); }\n#[test]\nfn d() {}\n}\n",
            ),
        ];
        let breaches = [("core/src/lib.rs", 6), ("core/tests/real/main.rs", 1)];
        check(sources::turns, &texts, &breaches);
    }

    #[test]
    fn when_the_glossary_lacks_a_term_or_the_map_a_package() {
        let map = "## The map\n| `core/` | `blastema-core` |\n";
        let texts = [("ARCHITECTURE.md", map), ("core/Cargo.toml", CORE)];
        assert!(!pages::glossary(&Tree::of_texts(&texts)).is_empty());
        check(pages::map, &texts, &[]);
        let without = [("ARCHITECTURE.md", "## The map\n"), ("core/Cargo.toml", CORE)];
        check(pages::map, &without, &[("ARCHITECTURE.md", 1)]);
    }
}
