//! Tests of the dashboard: a plant, events and keys, and the screens after them.

mod screens;
mod writes;

use std::time::Duration;

use fatek::command::StatusFlags;
use fatek::plant::Plant;
use fatek::tag::TagValue;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::layout::Size;
use tokio::time::Instant;

use super::model::{
    Connection, Counters, Effect, Event, Focus, Health, Level, Model, PlcInfo, Reading, RoundTrip, Settings, TagInfo,
    Trouble,
};
use super::theme::Theme;
use super::view;
use crate::names::{NamedTag, Table};
use crate::screen::Key;

const PLANT: &str = "
[plc.mixer]
link = 'tcp://10.0.0.3:500'
station = 1
tag.level = { at = 'R5:i16*0.1-40', unit = '%', comment = 'level of the tank' }
tag.setpoint = { at = 'R200:f32', unit = '%', write = { min = 0.0, max = 80.0 } }
tag.batch = { at = 'R20-R29:text', write = {} }
tag.limits = { at = 'R30-R31', write = { max = 9.0 } }
tag.bit = { at = 'R40.3', write = {} }
tag.clock = { at = 'R4128', write = {} }
[plc.boiler]
link = 'udp://10.0.0.9:500'
station = 12
tag.level = { at = 'R5:i16*0.1-40', unit = '%' }
tag.alarm = 'M7'
";

/// A dashboard of a plant, with a clock.
struct Bench {
    model: Model,
    now: Instant,
}

impl Bench {
    fn new() -> Self {
        Self::with(Settings { interval: Duration::from_secs(1), special: false, read_only: false })
    }

    fn with(settings: Settings) -> Self {
        Self::of_plant(PLANT, settings)
    }

    fn of_plant(plant: &str, settings: Settings) -> Self {
        let plant = Plant::from_toml(plant).unwrap();
        let (mut plcs, mut tags) = (Vec::new(), Vec::new());
        for (number, plc) in plant.plcs().enumerate() {
            let names = Table::of_plc(plc);
            let named = names.all();
            let address = format!("{} station {}", plc.endpoint(), plc.station());
            let info = PlcInfo::new(plc.name(), &address, names);
            let singles = named.iter().flat_map(NamedTag::singles);
            tags.extend(singles.map(|(label, single)| TagInfo::new(number, &info, &label, single)));
            plcs.push(info);
        }
        let now = Instant::now();
        let mut bench = Self { model: Model::new(settings, plcs, tags, now), now };
        bench.resize(80, 24);
        bench
    }

    /// The same without tags.
    fn without_tags() -> Self {
        let mut bench = Self::new();
        let Model { settings, plcs, .. } = bench.model;
        bench.model = Model::new(settings, plcs, Vec::new(), bench.now);
        bench.resize(80, 24);
        bench
    }

    fn resize(&mut self, width: u16, height: u16) {
        self.model.update(Event::Resize(Size::new(width, height)));
    }

    fn wait(&mut self, seconds: u64) {
        self.now += Duration::from_secs(seconds);
        self.frame();
    }

    /// A frame that is on the terminal at once.
    fn frame(&mut self) {
        self.model.frame(self.now);
        self.model.drawn(self.now);
    }

    /// The number of a tag, by its PLC and label.
    fn tag(&self, subject: &str) -> usize {
        (0..self.model.tags.len()).find(|&tag| self.model.subject(tag) == subject).expect(subject)
    }

    fn good(&mut self, subject: &str, value: TagValue) {
        let (tag, at) = (self.tag(subject), self.now);
        let reading = Reading { tag, value: Some(value), level: Level::Good, reason: String::new(), trouble: None, at };
        self.model.update(Event::Reading(reading));
    }

    fn bad(&mut self, subject: &str, reason: &str) {
        let (tag, at) = (self.tag(subject), self.now);
        let trouble = Some(Trouble { word: "no reply", text: reason.to_owned() });
        let reading = Reading { tag, value: None, level: Level::Bad, reason: reason.to_owned(), trouble, at };
        self.model.update(Event::Reading(reading));
    }

    /// Types keys: the characters of a text.
    fn types(&mut self, text: &str) -> Vec<Effect> {
        text.chars().filter_map(|character| self.presses(key_of(character))).collect()
    }

    fn presses(&mut self, key: Key) -> Option<Effect> {
        let effect = self.model.update(Event::Key(key, self.now));
        self.frame();
        effect
    }

    /// Types keys in one burst: without a frame between them.
    fn bursts(&mut self, text: &str) -> Vec<Effect> {
        text.chars().filter_map(|character| self.model.update(Event::Key(key_of(character), self.now))).collect()
    }

    /// Selects a tag.
    fn select(&mut self, subject: &str) {
        let tag = self.tag(subject);
        self.presses(Key::Home);
        while self.model.tag_list.selected() != Some(tag) {
            self.presses(Key::Down);
        }
    }

    fn draw(&mut self, has_colours: bool) -> Buffer {
        self.frame();
        let Size { width, height } = self.model.size;
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| view::draw(&self.model, Theme::new(has_colours), frame)).unwrap();
        terminal.backend().buffer().clone()
    }

    /// The lines of the screen.
    fn screen(&mut self) -> String {
        let buffer = self.draw(false);
        let cells: Vec<&str> = buffer.content().iter().map(|cell| cell.symbol()).collect();
        let width = usize::from(self.model.size.width).max(1);
        let lines: Vec<String> = cells.chunks(width).map(|line| line.concat().trim_end().to_owned()).collect();
        lines.join("\n") + "\n"
    }

    fn message(&self) -> &str {
        self.model.message.as_ref().map_or("", |message| &message.text)
    }

    /// The labels of the tags that are shown, in their order.
    fn labels(&self) -> String {
        let shown = self.model.tag_list.shown(usize::MAX);
        shown.iter().map(|&tag| self.model.subject(tag)).collect::<Vec<_>>().join(" ")
    }
}

/// The key of a character.
fn key_of(character: char) -> Key {
    match character {
        '\n' => Key::Enter,
        '\t' => Key::Tab,
        character => Key::Char(character),
    }
}

/// A PLC that answers, one that does not, and values of all kinds.
fn running() -> Bench {
    let mut bench = Bench::new();
    let ms = Duration::from_millis;
    let round_trip = Some(RoundTrip { last: ms(12), mean: ms(9), longest: ms(150) });
    let counters = Counters { round_trip, requests: 1234, errors: 1, timeouts: 0, retries: 2 };
    let up = Health { connection: Connection::Up, has_answered: true, counters, ..Health::default() };
    let reason = "connection refused".to_owned();
    let timeouts = Counters { timeouts: 3, requests: 3, ..Counters::default() };
    let down = Health { connection: Connection::Down, reason, counters: timeouts, ..Health::default() };
    bench.model.update(Event::Health { plc: 0, health: up });
    bench.model.update(Event::Health { plc: 1, health: down });
    bench.model.update(Event::Status { plc: 0, status: Ok(StatusFlags(1)) });
    for second in 0..30 {
        bench.wait(1);
        bench.good("mixer/level", TagValue::Scaled(f64::from(second % 8) / 2.0));
        bench.good("mixer/setpoint", TagValue::F32(21.5));
    }
    bench.good("mixer/batch", TagValue::Text("AB\x1b[31m\u{202e}1".to_owned()));
    bench.good("mixer/limits[0]", TagValue::U16(7));
    bench.good("mixer/limits[1]", TagValue::U16(65_535));
    bench.good("mixer/bit", TagValue::Bool(true));
    bench.bad("boiler/level", "no connection to udp://10.0.0.9:500: connection refused");
    bench.wait(2);
    bench
}

#[test]
fn tags_are_sorted_by_each_key_and_reversed() {
    let mut bench = running();
    let given = bench.labels();
    assert!(given.starts_with("mixer/level mixer/setpoint mixer/batch"), "{given}");
    bench.types("s");
    assert!(bench.labels().starts_with("boiler/alarm mixer/batch mixer/bit mixer/clock"), "{}", bench.labels());
    bench.types("s");
    let by_value = bench.labels();
    assert!(by_value.starts_with("mixer/bit mixer/level mixer/limits[0] mixer/setpoint mixer/limits[1] mixer/batch"));
    bench.types("r");
    let reversed = bench.labels();
    assert!(reversed.starts_with("mixer/batch mixer/limits[1] mixer/setpoint"), "{reversed}");
    assert!(reversed.ends_with("mixer/clock boiler/level boiler/alarm"), "missing values are the last: {reversed}");
    bench.types("s");
    assert!(bench.labels().starts_with("boiler/level mixer/clock boiler/alarm"), "by quality: {}", bench.labels());
    bench.types("s");
    bench.wait(1);
    bench.good("boiler/alarm", TagValue::Bool(false));
    bench.wait(0);
    assert!(bench.labels().starts_with("boiler/alarm "), "by age: {}", bench.labels());
    bench.types("s");
    assert!(bench.labels().ends_with("mixer/setpoint boiler/alarm boiler/level"), "by PLC: {}", bench.labels());
    bench.types("s");
    assert_eq!(bench.labels(), given);
}

#[test]
fn the_selected_tag_stays_selected_when_values_change_the_order() {
    let mut bench = running();
    bench.select("mixer/limits[0]");
    bench.types("ss");
    for value in [1, 60_000, 3] {
        bench.good("mixer/limits[0]", TagValue::U16(value));
        bench.wait(1);
        assert_eq!(bench.model.tag_list.selected(), Some(bench.tag("mixer/limits[0]")));
    }
}

#[test]
fn a_filter_is_applied_as_it_is_typed_and_cleared_by_escape() {
    let mut bench = running();
    let all = bench.labels();
    bench.types("/BOIL");
    assert_eq!(bench.labels(), "boiler/level boiler/alarm");
    bench.types("er/a");
    assert_eq!(bench.labels(), "boiler/alarm");
    bench.presses(Key::Enter);
    // A key again, and no part of the filter.
    bench.types("s");
    assert_eq!((bench.labels().as_str(), bench.model.filter.as_str()), ("boiler/alarm", "BOILer/a"));
    bench.types("s/zzz");
    assert_eq!((bench.labels().as_str(), bench.model.tag_list.selected()), ("", None));
    assert!(bench.screen().contains("nothing matches the filter"));
    bench.presses(Key::Escape);
    assert_eq!(bench.model.filter, "BOILer/a", "the filter before it was edited");
    bench.presses(Key::Escape);
    bench.types("ssss");
    assert_eq!(bench.labels(), all);
    // By element.
    bench.types("/r200");
    assert_eq!(bench.labels(), "mixer/setpoint");
}

#[test]
fn keys_of_a_burst_are_for_the_tags_that_will_be_shown() {
    let mut bench = running();
    bench.select("mixer/setpoint");
    // Without a frame between the keys, `w` was for a tag that the filter had hidden.
    bench.bursts("/r30\nw");
    assert!(bench.screen().contains("new value of mixer/limits[0]:"), "{}", bench.screen());
    let mut bench = running();
    bench.bursts("sgw");
    assert_eq!(
        bench.message(),
        "alarm is not writable: it has no `write` in the plant; to write it nevertheless, name M7"
    );
    let mut bench = running();
    bench.types("/");
    bench.model.update(Event::Paste("r31".to_owned()));
    bench.bursts("\nw");
    assert!(bench.screen().contains("new value of mixer/limits[1]:"), "{}", bench.screen());
}

#[test]
fn a_paused_display_stands_still_while_polling_goes_on() {
    let mut bench = running();
    bench.types(" ");
    let paused = bench.screen();
    assert!(paused.starts_with(" PAUSED · fatek top"), "{paused}");
    bench.wait(50);
    bench.good("mixer/setpoint", TagValue::F32(77.25));
    bench.model.update(Event::Status { plc: 0, status: Ok(StatusFlags(0)) });
    assert_eq!(bench.screen(), paused);
    // A prompt has the present value.
    bench.select("mixer/setpoint");
    bench.types("w5");
    bench.presses(Key::Enter);
    assert!(bench.screen().contains("Now  77.25 %"), "{}", bench.screen());
    bench.types("n ");
    let shown = bench.screen();
    assert!(!shown.contains("PAUSED") && shown.contains("77.25") && shown.contains(" stop "), "{shown}");
}

#[test]
fn q_and_ctrl_c_quit_in_every_mode_where_they_are_keys() {
    for keys in ["", "?", "/abc", "w1", "w1\n"] {
        let mut bench = running();
        bench.select("mixer/setpoint");
        bench.types(keys);
        assert!(matches!(bench.presses(Key::Control('c')), Some(Effect::Quit)), "{keys}");
    }
    let mut bench = running();
    assert!(matches!(bench.presses(Key::Char('q')), Some(Effect::Quit)));
    assert!(bench.types("/q").is_empty(), "a filter may have a q");
}

#[test]
fn a_failed_request_shows_at_the_plc_until_the_next_reply() {
    let mut bench = running();
    bench.bad("mixer/level", "no reply within 1s");
    assert!(bench.screen().contains("mixer   up       no reply"), "{}", bench.screen());
    bench.good("mixer/setpoint", TagValue::F32(1.0));
    assert!(bench.screen().contains("mixer   up       online"), "{}", bench.screen());
    let trouble = Trouble { word: "no reply", text: "no reply within 1s".to_owned() };
    bench.model.update(Event::Status { plc: 0, status: Err(trouble) });
    assert!(bench.screen().contains("mixer   up       no reply   -"), "the mode is unknown: {}", bench.screen());
    bench.model.update(Event::Status { plc: 0, status: Ok(StatusFlags(1)) });
    assert!(bench.screen().contains("mixer   up       online     run"), "{}", bench.screen());
}

#[test]
fn a_stale_value_is_no_part_of_the_trend() {
    let mut bench = Bench::new();
    let (tag, at) = (bench.tag("mixer/setpoint"), bench.now);
    let value = Some(TagValue::F32(7.0));
    for level in [Level::Good, Level::Stale, Level::Good] {
        let reading = Reading { tag, value: value.clone(), level, reason: String::new(), trouble: None, at };
        bench.model.update(Event::Reading(reading));
    }
    assert_eq!(bench.model.live.tags[tag].history.sparkline(9), "▄ ▄");
}

#[test]
fn the_tab_key_moves_to_the_plcs_and_back() {
    let mut bench = running();
    bench.presses(Key::Tab);
    bench.presses(Key::Down);
    assert_eq!((bench.model.focus, bench.model.plc_list.selected()), (Focus::Plcs, Some(1)));
    assert!(bench.screen().contains("boiler  udp://10.0.0.9:500 station 12"), "{}", bench.screen());
    bench.types("w");
    assert_eq!(bench.message(), "no tag is selected");
    bench.presses(Key::Tab);
    assert_eq!(bench.model.plc_list.selected(), Some(0), "that of the selected tag");
}

#[test]
fn dropped_readings_are_reported() {
    let mut bench = running();
    bench.model.update(Event::Missed(12));
    assert_eq!(bench.message(), "12 readings were dropped: the display is too slow");
}
