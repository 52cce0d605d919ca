//! Data of a frame, read as a reply.
//!
//! The request is unknown, so every number of values that a request can ask for is accepted.

use fatek::ErrorCode;
use fatek::command::{
    BriefStatus, Class, Code, DetailedStatus, ErrorField, MAX_LOOP_BACK, MAX_POINTS, MAX_UNITS, PAGE_WORDS,
};
use fatek::wire::{FieldError, FieldReader};

use super::recorder::Recorder;
use super::text;

/// Reads a reply of `length` bytes.
pub(super) fn read<R: FieldReader + Clone>(
    code: Code,
    length: usize,
    fields: &mut Recorder<'_, R>,
) -> Result<(), FieldError> {
    let has_error_code = match code.error_field() {
        ErrorField::Absent => false,
        ErrorField::ByLength => length != PAGE_CHARACTERS,
        ErrorField::Leading | _ => true,
    };
    read_result(code, has_error_code, fields)?;
    fields.finish()
}

/// Length of a program page without error code in the ASCII framing. The binary framing has no
/// program pages.
const PAGE_CHARACTERS: usize = 4 * PAGE_WORDS;

fn read_result<R: FieldReader + Clone>(
    code: Code,
    has_error_code: bool,
    fields: &mut Recorder<'_, R>,
) -> Result<(), FieldError> {
    if has_error_code {
        let error = fields.named("error code", R::code, |code| match ErrorCode::from_u8(*code) {
            None => "ok (0)".to_owned(),
            Some(error) => error.to_string(),
        })?;
        // A reply with an error code has no data.
        if error != 0 {
            return Ok(());
        }
    }
    match code {
        Code::ReadStatus => brief_status(fields),
        Code::ReadDetailedStatus => detailed_status(fields),
        Code::ReadDisabled | Code::ReadDiscretes => states(fields),
        Code::ReadRegisters => registers(fields),
        Code::ReadMixed => mixed(fields),
        Code::ReadProgramPage => (0..PAGE_WORDS).try_for_each(|_| fields.word().map(drop)),
        Code::LoopBack => echo(fields),
        Code::ControlPlc
        | Code::ControlDiscrete
        | Code::WriteDiscretes
        | Code::WriteRegisters
        | Code::WriteMixed
        | Code::WriteProgramPage => Ok(()),
        // A command that has no description here: a write has no data, the data of a read is shown as it is.
        _ if code.class() == Class::Read => rest(fields),
        _ => Ok(()),
    }
}

fn brief_status<R: FieldReader + Clone>(fields: &mut Recorder<'_, R>) -> Result<(), FieldError> {
    let status = |raw| BriefStatus::from_raw(raw);
    fields.named("STATUS1", R::byte, |&byte| status([byte, 0, 0]).flags().to_string())?;
    fields.named("STATUS2", R::byte, |&byte| format!("program capacity: {}", status([0, byte, 0]).capacity()))?;
    fields.named("STATUS3", R::byte, |byte| format!("{byte:02X}h, reserved"))?;
    Ok(())
}

fn detailed_status<R: FieldReader + Clone>(fields: &mut Recorder<'_, R>) -> Result<(), FieldError> {
    // The library decodes a copy; its values are shown with the bytes they come from.
    let mut ahead = fields.clone();
    let mut raw = Vec::new();
    while !ahead.is_empty() {
        raw.push(ahead.byte()?);
    }
    let status = DetailedStatus::from_raw(raw).ok_or(FieldError::Truncated)?;
    let (major, minor) = status.os_version();
    fields.named("STATUS1", R::byte, |_| status.flags().to_string())?;
    fields.named("STATUS2", R::byte, |_| format!("main unit: {}", status.main_unit()))?;
    fields.named("STATUS3", R::byte, |byte| format!("I/O points of the main unit: code {byte:02X}h"))?;
    fields.named("STATUS4", R::byte, |_| format!("operating system: version {major}.{minor}"))?;
    for (name, number) in [
        ("ladder", status.ladder_words()),
        ("inputs", status.discrete_inputs()),
        ("outputs", status.discrete_outputs()),
        ("analog inputs", status.analog_inputs()),
        ("analog outputs", status.analog_outputs()),
        ("M", status.m_relays()),
        ("S", status.s_relays()),
        ("L", status.l_relays()),
        ("R", status.r_registers()),
        ("D", status.d_registers()),
        ("timers", status.timers()),
        ("counters", status.counters()),
    ] {
        let unit = if name == "ladder" { " words" } else { "" };
        fields.named(name, R::word, |_| format!("{number}{unit}"))?;
    }
    if !fields.is_empty() {
        fields.named("STATUS29 on", rest, |_| "reserved".to_owned())?;
    }
    Ok(())
}

fn states<R: FieldReader + Clone>(fields: &mut Recorder<'_, R>) -> Result<(), FieldError> {
    let mut count = 0;
    while count == 0 || (count < MAX_POINTS && !fields.is_empty()) {
        fields.bit()?;
        count += 1;
    }
    Ok(())
}

fn registers<R: FieldReader + Clone>(fields: &mut Recorder<'_, R>) -> Result<(), FieldError> {
    let mut words = Vec::new();
    while words.is_empty() || (words.len() < MAX_UNITS && !fields.is_empty()) {
        words.push(fields.word()?);
    }
    if words.len().is_multiple_of(2) {
        let dwords = words.chunks_exact(2).map(|pair| text::dword(u32::from(pair[0]) << 16 | u32::from(pair[1])));
        fields.remark("as 32 bits", dwords.collect::<Vec<_>>().join("; "));
    }
    Ok(())
}

fn mixed<R: FieldReader + Clone>(fields: &mut Recorder<'_, R>) -> Result<(), FieldError> {
    // In the ASCII framing all data must be hexadecimal digits.
    let mut digits = fields.clone();
    while !digits.is_empty() {
        digits.named("digit", R::code, |_| String::new())?;
    }
    if fields.is_empty() {
        return Err(FieldError::Truncated);
    }
    fields.named("values", rest, |_| "in the order of the request, each as wide as its element".to_owned())?;
    Ok(())
}

fn echo<R: FieldReader>(fields: &mut R) -> Result<(), FieldError> {
    if fields.rest().len() > MAX_LOOP_BACK { Err(FieldError::Trailing) } else { Ok(()) }
}

fn rest<R: FieldReader>(fields: &mut R) -> Result<(), FieldError> {
    fields.rest();
    Ok(())
}
