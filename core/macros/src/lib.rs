//! Derives for the contracts of the Blastema middleware.
