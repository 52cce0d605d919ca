//! Audits of the crate `fatek`; all of them are in `tests/`.
