//! Subcommands `fatek run`, `stop`, and `enable`, `disable`, `set` and `reset DISCRETE…`.

use std::cell::Cell;
use std::fmt;

use fatek::command::{Command, ControlDiscrete, ControlPlc, DiscreteControl};
use fatek::{Discrete, Station};

use crate::failure::Failure;
use crate::output::Output;
use crate::signal::unless_signalled;

pub(crate) async fn plc(station: &Station, control: ControlPlc, output: &Output) -> Result<(), Failure> {
    send(station, control, &name(control), output).await
}

/// Sends one command for each discrete, in the order given.
pub(crate) async fn discretes(
    station: &Station,
    control: DiscreteControl,
    discretes: &[Discrete],
    output: &Output,
) -> Result<(), Failure> {
    let done = Cell::new(0);
    let action = |discrete: &Discrete| format!("{} {discrete}", name(control));
    let all = async {
        for &discrete in discretes {
            send(station, ControlDiscrete::new(control, discrete), &action(&discrete), output).await?;
            done.set(done.get() + 1);
        }
        Ok(())
    };
    unless_signalled(all).await?.map_err(|signal| {
        let perhaps = discretes.get(done.get()).map_or(String::new(), |next| format!(", {} perhaps", action(next)));
        let executed = format!(": {} of {} commands were executed{perhaps}", done.get(), discretes.len());
        Failure::interrupted(executed)(signal)
    })?
}

/// The subcommand of a variant: `stop` of `Stop`.
fn name(control: impl fmt::Debug) -> String {
    format!("{control:?}").to_lowercase()
}

async fn send(
    station: &Station,
    command: impl Command<Reply = ()>,
    action: &str,
    output: &Output,
) -> Result<(), Failure> {
    station.call(command).await.map_err(|error| {
        let doubt = if error.may_have_executed() { " (it may have been executed)" } else { "" };
        Failure::of(format_args!("{action}{doubt}"))(error)
    })?;
    output.remark(format_args!("{action}: done"));
    Ok(())
}
