//! Test doubles that speak the contract of the Blastema middleware.
