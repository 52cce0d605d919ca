//! Screens at exact sizes.

use ratatui::buffer::Cell;
use ratatui::style::{Color, Modifier};

use super::*;

#[test]
fn the_screen_at_80_by_24() {
    let shown = running().screen();
    assert_eq!(shown, include_str!("80x24.txt"), "\n{shown}");
}

#[test]
fn the_screen_at_120_by_40() {
    let mut bench = running();
    bench.resize(120, 40);
    let shown = bench.screen();
    assert_eq!(shown, include_str!("120x40.txt"), "\n{shown}");
}

#[test]
fn the_screen_without_tags() {
    let mut bench = Bench::without_tags();
    bench.resize(80, 8);
    let shown = bench.screen();
    assert_eq!(shown, include_str!("plcs.txt"), "\n{shown}");
}

#[test]
fn a_small_terminal_shows_the_selected_tag() {
    let mut bench = running();
    bench.select("mixer/setpoint");
    for (width, height, expected) in [
        (20, 1, "setpoint        21.5\n"),
        (8, 1, "set…  2…\n"),
        (1, 1, "…\n"),
        (30, 2, "TAG               VALUE\nsetpoint           21.5\n"),
    ] {
        bench.resize(width, height);
        let shown = bench.screen();
        assert_eq!(shown, expected, "{width}x{height}:\n{shown}");
    }
}

#[test]
fn every_size_and_mode_can_be_drawn() {
    for keys in ["", "?", "/le", "w5", "w99\n", "w5\n", "\t"] {
        let mut bench = running();
        bench.select("mixer/setpoint");
        bench.types(keys);
        // With a window where there is a place for it.
        bench.model.update(Event::Written(Err("R200 (it may have been written): no reply ".repeat(9))));
        for width in (0..90).step_by(7).chain([1, 2, 4, 120, 300]) {
            for height in (0..13).chain([16, 20, 24, 40, 100]) {
                bench.resize(width, height);
                bench.draw(true);
            }
        }
    }
}

#[test]
fn a_terminal_that_has_become_smaller_meanwhile_can_be_drawn() {
    let mut bench = running();
    bench.types("?");
    bench.model.frame(bench.now);
    let mut terminal = Terminal::new(TestBackend::new(10, 3)).unwrap();
    terminal.draw(|frame| view::draw(&bench.model, Theme::new(true), frame)).unwrap();
}

#[test]
fn texts_of_the_plc_do_not_reach_the_terminal_raw() {
    let mut bench = running();
    bench.select("mixer/batch");
    let shown = bench.screen();
    assert!(shown.contains(r"AB\x1B[31m\u{202e}1") || shown.contains(r"AB\u{1b}[31m\u{202e}1"), "{shown}");
    assert!(shown.chars().all(|character| character == '\n' || !crate::printable::is_unprintable(character)));
}

#[test]
fn without_colours_there_are_bold_and_reversed_texts_only() {
    let mut bench = running();
    let is_plain = |cell: &Cell| cell.fg == Color::Reset && cell.bg == Color::Reset;
    let buffer = bench.draw(false);
    assert!(buffer.content().iter().all(is_plain));
    let other = !(Modifier::BOLD | Modifier::REVERSED);
    assert!(buffer.content().iter().all(|cell| !cell.modifier.intersects(other)));
    let coloured = bench.draw(true);
    assert!(coloured.content().iter().any(|cell| cell.fg == Color::Red));
    let symbols = |buffer: &Buffer| buffer.content().iter().map(|cell| cell.symbol().to_owned()).collect::<Vec<_>>();
    assert_eq!(symbols(&buffer), symbols(&coloured), "no colour has a meaning that the text has not");
}

#[test]
fn the_help_names_the_keys_at_80_by_24() {
    let mut bench = running();
    bench.types("?");
    let shown = bench.screen();
    for key in ["s, r", "/  ", "space, p", "w, Enter", "q, Ctrl-C", "TREND"] {
        assert!(shown.contains(&format!("│ {key}")), "{key}: {shown}");
    }
    bench.types("x");
    assert!(!bench.screen().contains("┌ Keys"));
}
