//! A PLC in memory.
