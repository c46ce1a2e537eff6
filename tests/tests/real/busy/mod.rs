//! Nodes on real threads whose handlers burn time, judged by counts and order, never by speed.

mod fairness;
mod shutdown;
