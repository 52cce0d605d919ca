//! Subcommands `fatek run`, `stop`, and `enable`, `disable`, `set` and `reset DISCRETE…`.

use std::fmt;

use fatek::{Discrete, Error, Station};

use crate::failure::Failure;
use crate::output::Output;

pub(crate) async fn run(station: &Station, output: &Output) -> Result<(), Failure> {
    done(station.run().await, format_args!("run"), output)
}

pub(crate) async fn stop(station: &Station, output: &Output) -> Result<(), Failure> {
    done(station.stop().await, format_args!("stop"), output)
}

pub(crate) async fn enable(station: &Station, discretes: &[Discrete], output: &Output) -> Result<(), Failure> {
    for &discrete in discretes {
        done(station.enable(discrete).await, format_args!("enable {discrete}"), output)?;
    }
    Ok(())
}

pub(crate) async fn disable(station: &Station, discretes: &[Discrete], output: &Output) -> Result<(), Failure> {
    for &discrete in discretes {
        done(station.disable(discrete).await, format_args!("disable {discrete}"), output)?;
    }
    Ok(())
}

pub(crate) async fn set(station: &Station, discretes: &[Discrete], output: &Output) -> Result<(), Failure> {
    for &discrete in discretes {
        done(station.set(discrete).await, format_args!("set {discrete}"), output)?;
    }
    Ok(())
}

pub(crate) async fn reset(station: &Station, discretes: &[Discrete], output: &Output) -> Result<(), Failure> {
    for &discrete in discretes {
        done(station.reset(discrete).await, format_args!("reset {discrete}"), output)?;
    }
    Ok(())
}

fn done(result: Result<(), Error>, what: fmt::Arguments<'_>, output: &Output) -> Result<(), Failure> {
    result.map_err(|error| {
        let doubt = if error.may_have_executed() { " (it may have been executed)" } else { "" };
        Failure::of(format_args!("{what}{doubt}"))(error)
    })?;
    output.remark(format_args!("{what}: done"));
    Ok(())
}
