use std::time::Duration;

use bytes::BytesMut;

use super::*;
