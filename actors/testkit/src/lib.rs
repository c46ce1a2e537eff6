//! For tests of Blastema components: a test node, probes, a paused clock.
