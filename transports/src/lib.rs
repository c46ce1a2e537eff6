//! Media of the Blastema middleware, one file each.
