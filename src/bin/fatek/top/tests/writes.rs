//! Writes: what is asked, what is sent, and what is refused.

use super::*;

fn written(effects: &[Effect]) -> Vec<String> {
    let text = |effect: &Effect| match effect {
        Effect::Write { plc, write } => Some(format!("{plc}: {write}")),
        Effect::Quit | Effect::Redraw => None,
    };
    effects.iter().filter_map(text).collect()
}

/// Opens the prompt for a value.
fn prompt(bench: &mut Bench, subject: &str, value: &str) {
    bench.select(subject);
    bench.types("w");
    bench.types(value);
    bench.presses(Key::Enter);
}

/// Returns whether the prompt is shown.
fn asks(bench: &mut Bench) -> bool {
    bench.screen().contains("Write it? y: yes, any other key: no")
}

#[test]
fn only_y_at_the_prompt_sends_the_value() {
    for no in ["n", "q", " ", "w"] {
        let mut bench = running();
        prompt(&mut bench, "mixer/setpoint", "30");
        assert!(asks(&mut bench));
        assert_eq!(written(&bench.types(no)), [""; 0], "{no}");
        assert!(!asks(&mut bench) && bench.message() == "nothing was written");
        assert_eq!(written(&bench.types("y")), [""; 0]);
    }
    for code in [Key::Enter, Key::Escape, Key::Tab, Key::Other] {
        let mut bench = running();
        prompt(&mut bench, "mixer/setpoint", "30");
        assert!(bench.presses(code).is_none() && bench.message() == "nothing was written");
    }
    let mut bench = running();
    prompt(&mut bench, "mixer/setpoint", "30");
    assert_eq!(written(&bench.types("y")), ["0: setpoint=30.0"]);
}

#[test]
fn the_prompt_states_plc_tag_present_and_new_value() {
    let mut bench = running();
    prompt(&mut bench, "mixer/setpoint", "30.25");
    let shown = bench.screen();
    for line in ["PLC  mixer (tcp://10.0.0.3:500 station 1)", "Tag  setpoint (R200:f32)", "Now  21.5 %", "New  30.25 %"]
    {
        assert!(shown.contains(&format!("│ {line} ")), "{line}: {shown}");
    }
    // The present value is that of now.
    bench.good("mixer/setpoint", TagValue::F32(22.0));
    assert!(bench.screen().contains("│ Now  22.0 % "), "{}", bench.screen());
    bench.bad("mixer/setpoint", "no reply");
    assert!(bench.screen().contains("│ Now  no value (bad: no reply) "), "{}", bench.screen());
}

#[test]
fn the_result_of_a_write_is_shown_and_the_next_one_waits_for_it() {
    let mut bench = running();
    prompt(&mut bench, "mixer/limits[1]", "7");
    assert_eq!(written(&bench.types("y")), ["0: R31=7"]);
    assert_eq!(bench.message(), "writing mixer/limits[1]=7...");
    bench.types("w");
    assert_eq!(bench.message(), "the last write has no result yet");
    bench.model.update(Event::Written(Ok(())));
    assert_eq!(bench.message(), "wrote mixer/limits[1]=7");
    prompt(&mut bench, "mixer/limits[1]", "8");
    assert_eq!(written(&bench.types("y")), ["0: R31=8"]);
    bench.model.update(Event::Written(Err("R31 (it may have been written): no reply\n".to_owned())));
    let shown = bench.screen();
    let window = "┌ Write not confirmed; Esc closes ";
    assert!(shown.contains(window), "{shown}");
    assert!(shown.contains("│ mixer/limits[1]=8: R31 (it may have been written): no reply\\n "), "{shown}");
}

/// A dashboard with a write that has failed, and no frame since then.
fn failed() -> Bench {
    failed_with("R31 (it may have been written): no reply")
}

fn failed_with(reason: &str) -> Bench {
    let mut bench = running();
    prompt(&mut bench, "mixer/limits[1]", "8");
    bench.types("y");
    bench.model.update(Event::Written(Err(reason.to_owned())));
    bench
}

fn shows_failure(bench: &mut Bench) -> bool {
    bench.screen().contains("│ mixer/limits[1]=8: R31 (it may have been written): no reply ")
}

#[test]
fn a_failed_write_is_shown_until_a_key_follows_it() {
    let mut bench = failed();
    // These hid it before the first frame.
    bench.bursts("jkss");
    bench.model.update(Event::Missed(12));
    assert!(shows_failure(&mut bench), "{}", bench.screen());
    // Of the time before the frame.
    let before = bench.now - Duration::from_millis(1);
    bench.model.update(Event::Key(Key::Char('j'), before));
    assert!(shows_failure(&mut bench));
    bench.types("j");
    assert!(!shows_failure(&mut bench));

    let mut bench = failed();
    bench.types("/mixer\n");
    bench.presses(Key::Escape);
    assert!(!shows_failure(&mut bench) && bench.model.filter == "mixer", "Esc closes the window alone");
}

#[test]
fn no_write_begins_before_the_failure_of_the_last_one_is_shown() {
    let mut bench = failed();
    bench.bursts("w");
    assert_eq!(bench.message(), "the failure of the last write was not shown yet");
    // The help hides it.
    let mut bench = failed();
    bench.bursts("?");
    assert!(!shows_failure(&mut bench));
    assert_eq!(bench.model.unseen().count(), 1);
    bench.types("x");
    assert!(shows_failure(&mut bench));
    assert_eq!(bench.model.unseen().count(), 0);
    bench.types("w");
    assert!(bench.screen().contains("new value of mixer/limits[1]:"), "{}", bench.screen());
}

#[test]
fn a_long_reason_of_a_failed_write_is_shown_whole() {
    let reason = "R31 (it may have been written): station 1 did not answer within 1s, at tcp://10.0.0.3:500, the end";
    let mut bench = failed_with(reason);
    assert!(bench.screen().contains("the end"), "{}", bench.screen());
    // A small terminal has it at the foot.
    let mut bench = failed_with(reason);
    bench.resize(80, 3);
    let shown = bench.screen();
    assert!(shown.contains("\nmixer/limits[1]=8: R31 (it may have been written): station 1 "), "{shown}");
}

#[test]
fn writes_without_a_result_are_reported_at_the_end() {
    let unseen = |bench: &Bench| bench.model.unseen().collect::<Vec<_>>();
    let mut bench = running();
    assert!(unseen(&bench).is_empty());
    prompt(&mut bench, "mixer/limits[1]", "8");
    bench.types("yq");
    assert_eq!(unseen(&bench), ["the write mixer/limits[1]=8 had no reply yet: it may have been executed"]);
    let bench = failed();
    assert_eq!(unseen(&bench), ["not confirmed: mixer/limits[1]=8: R31 (it may have been written): no reply"]);
}

#[test]
fn prompt_and_result_have_the_value_that_is_stored() {
    let plant = "
[plc.mixer]
link = 'tcp://10.0.0.3:500'
station = 1
tag.sc = { at = 'R12:i16*0.1', unit = '%', write = {} }
";
    let mut bench =
        Bench::of_plant(plant, Settings { interval: Duration::from_secs(1), special: false, read_only: false });
    prompt(&mut bench, "sc", "1.23");
    // It was `1.23`.
    assert!(bench.screen().contains("│ New  1.2 % "), "{}", bench.screen());
    assert_eq!(bench.types("y").len(), 1);
    bench.model.update(Event::Written(Ok(())));
    assert_eq!(bench.message(), "wrote sc=1.2");
}

#[test]
fn values_and_tags_are_refused_by_the_rules_of_the_plant() {
    let mut bench = running();
    for (subject, value, fault) in [
        ("mixer/setpoint", "81", "setpoint is at most 80 in the plant"),
        ("mixer/setpoint", "-1", "setpoint is at least 0 in the plant"),
        ("mixer/limits[0]", "10", "limits is at most 9 in the plant"),
        // It passed both limits.
        ("mixer/setpoint", "nan", "setpoint is at least 0 in the plant"),
        ("mixer/setpoint", "inf", "setpoint is at most 80 in the plant"),
        ("mixer/setpoint", "abc", "abc"),
        ("mixer/setpoint", "", "``"),
        ("mixer/limits[0]", "1,2", "1,2"),
    ] {
        prompt(&mut bench, subject, value);
        assert!(!asks(&mut bench));
        let shown = bench.screen();
        assert!(shown.contains("Not accepted") && shown.contains(fault), "{subject}={value}: {shown}");
        assert_eq!(written(&bench.types("y")), [""; 0]);
        bench.presses(Key::Escape);
    }
    for (subject, fault) in [
        ("mixer/level", "level is not writable: it has no `write` in the plant"),
        ("boiler/alarm", "alarm is not writable: it has no `write` in the plant"),
        ("mixer/bit", "R40.3 is a part of R40; use `fatek write --modify-bits`"),
        ("mixer/clock", "R4128 is special"),
    ] {
        bench.select(subject);
        bench.types("w");
        assert!(bench.message().starts_with(fault), "{}", bench.message());
    }
    let settings = Settings { special: true, ..bench.model.settings };
    let mut bench = Bench::with(settings);
    prompt(&mut bench, "mixer/clock", "5");
    assert_eq!(written(&bench.types("y")), ["0: clock=5"]);
    let mut bench = Bench::with(Settings { read_only: true, ..settings });
    bench.select("mixer/setpoint");
    bench.types("w");
    assert_eq!(bench.message(), "--read-only was given");
}

#[test]
fn a_pasted_text_confirms_nothing() {
    let mut bench = running();
    bench.select("mixer/setpoint");
    bench.model.update(Event::Paste("w30\ny".to_owned()));
    assert!(bench.model.pending.is_none() && bench.message().is_empty());
    bench.types("w");
    bench.model.update(Event::Paste("30\r\ny".to_owned()));
    bench.presses(Key::Enter);
    assert!(bench.screen().contains("30y"), "{}", bench.screen());
    prompt(&mut bench, "mixer/setpoint", "");
    bench.presses(Key::Escape);
    prompt(&mut bench, "mixer/setpoint", "30");
    bench.model.update(Event::Paste("y".to_owned()));
    assert!(bench.model.pending.is_none() && asks(&mut bench));
}

#[test]
fn a_y_before_the_prompt_is_shown_confirms_nothing() {
    let mut bench = running();
    bench.select("mixer/setpoint");
    // As pasted into a terminal that does not mark pasted texts: no frame between the keys.
    assert_eq!(written(&bench.bursts("w30\ny")), [""; 0]);
    assert!(bench.model.pending.is_none() && asks(&mut bench));
    // Typed before the frame, and taken after it: this sent the value.
    let before = bench.now - Duration::from_millis(1);
    assert!(bench.model.update(Event::Key(Key::Char('y'), before)).is_none());
    assert!(asks(&mut bench));
    assert_eq!(written(&bench.types("y")), ["0: setpoint=30.0"]);
}

#[test]
fn a_prompt_that_does_not_fit_cannot_be_confirmed() {
    for (width, height) in [(1, 1), (80, 6), (15, 24), (3, 2)] {
        let mut bench = running();
        prompt(&mut bench, "mixer/setpoint", "30");
        bench.resize(width, height);
        bench.screen();
        assert_eq!(written(&bench.types("y")), [""; 0], "{width}x{height}");
        assert_eq!(bench.message(), "nothing was written: the terminal is too small for the prompt");
    }
    let mut bench = running();
    prompt(&mut bench, "mixer/setpoint", "30");
    bench.resize(40, 10);
    assert!(asks(&mut bench));
    assert_eq!(written(&bench.types("y")), ["0: setpoint=30.0"]);
}

#[test]
fn texts_are_written_as_typed_and_shown_escaped() {
    let mut bench = running();
    prompt(&mut bench, "mixer/batch", r#""\x1B[2J""#);
    let shown = bench.screen();
    assert!(shown.contains(r#"New  "\u{1b}[2J""#) || shown.contains(r#"New  "\x1B[2J""#), "{shown}");
    assert_eq!(bench.types("y").len(), 1);
}
