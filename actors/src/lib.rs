//! Fault-tolerant middleware for robots: typed actors that grow back.
