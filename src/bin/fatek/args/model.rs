//! The option `--model` of the commands for tags.

use std::str::FromStr;

use clap::Args;
use fatek::memory_map::{MemoryMap, ParsePlcModelError, PlcModel};
use fatek::tag::Tag;
use fatek::{Limits, Station};

use crate::failure::Failure;

#[derive(Debug, Args)]
pub(crate) struct ModelArgs {
    /// Model whose memory is checked before anything else is sent: fbe-28mc or fbs-20mc; auto: the
    /// sizes in the status of the PLC, which do not show gaps
    #[arg(long = "model", value_name = "MODEL")]
    choice: Option<ModelChoice>,
}

#[derive(Clone, Copy, Debug)]
enum ModelChoice {
    /// By the status (53).
    Auto,
    Of(PlcModel),
}

impl FromStr for ModelChoice {
    type Err = ParsePlcModelError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text.eq_ignore_ascii_case("auto") { Ok(Self::Auto) } else { text.parse().map(Self::Of) }
    }
}

impl ModelArgs {
    /// Checks that the model has these tags. Returns the limits of the model for a poller.
    pub(crate) async fn check(&self, station: &Station, tags: impl Iterator<Item = Tag>) -> Result<Limits, Failure> {
        let map = match self.choice {
            None => return Ok(Limits::new()),
            Some(ModelChoice::Of(model)) => MemoryMap::of(model),
            Some(ModelChoice::Auto) => MemoryMap::from_status(&station.read_detailed_status().await?),
        };
        for tag in tags {
            map.check_tag(&tag).map_err(|error| Failure::Usage(format!("{tag}: {error}")))?;
        }
        Ok(map.limits())
    }
}
