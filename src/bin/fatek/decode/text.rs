//! Descriptions of values.

use std::fmt::Write;

use fatek::command::Code;

/// Effect of a control code.
pub(super) fn control(code: Code, control: u8) -> String {
    let name = match (code, control) {
        (Code::ControlPlc, 0) => "stop",
        (Code::ControlPlc, 1) => "run",
        (Code::ControlDiscrete, 1) => "disable",
        (Code::ControlDiscrete, 2) => "enable",
        (Code::ControlDiscrete, 3) => "set",
        (Code::ControlDiscrete, 4) => "reset",
        _ => return format!("{control}, unknown"),
    };
    format!("{name} ({control})")
}

pub(super) fn state(on: bool, disabled: bool) -> &'static str {
    match (on, disabled) {
        (false, false) => "off (0)",
        (true, false) => "on (1)",
        (false, true) => "enabled (0)",
        (true, true) => "disabled (1)",
    }
}

/// Formats a word, as in `FFFEh: 65534, or -2`.
pub(super) fn word(word: u16) -> String {
    match word.cast_signed() {
        signed @ ..0 => format!("{word:04X}h: {word}, or {signed}"),
        _ => format!("{word:04X}h: {word}"),
    }
}

/// Formats a double word, as in `C3FA1000h: 3287945216, or -1007022080, or -500.125`.
pub(super) fn dword(dword: u32) -> String {
    let mut text = format!("{dword:08X}h: {dword}");
    if let signed @ ..0 = dword.cast_signed() {
        let _ = write!(text, ", or {signed}");
    }
    // Small integers are not shown as floats, which are then near 0.
    let float = f32::from_bits(dword);
    if (1e-6..1e12).contains(&float.abs()) {
        let _ = write!(text, ", or {float:?}");
    }
    text
}

/// Printable ASCII as text, other bytes by their number.
pub(super) fn bytes(bytes: &[u8]) -> String {
    if bytes.iter().all(|byte| (0x20..=0x7E).contains(byte)) {
        format!("{:?}", String::from_utf8_lossy(bytes))
    } else {
        format!("{} bytes", bytes.len())
    }
}
