//! Drawing of a chart.

use humantime::format_duration;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::Style;
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Chart, Dataset, GraphType, Paragraph};

use super::series::{NumberAxis, Plot, Series, extremes};
use crate::printable::printable;
use crate::top::theme::Theme;

const KEYS: &str = "q quit  + - zoom  space pause";

pub(super) fn draw(plot: &Plot, theme: Theme, is_ascii: bool, frame: &mut Frame<'_>) {
    let area = frame.area();
    // A small terminal has the chart alone.
    let [title, values, foot] = match area.height {
        0..6 => [0, 0, 0],
        6..12 => [1, 1, 0],
        12.. => [1, plot.series.len() as u16, 1],
    };
    let lines = [Constraint::Length(title), Constraint::Min(1), Constraint::Length(values), Constraint::Length(foot)];
    let [title, chart, values, foot] = Layout::vertical(lines).areas(area);

    let pause = if plot.is_paused { "PAUSED · " } else { "" };
    let text = format!(
        " {pause}{} · every {} · last {}",
        plot.title,
        format_duration(plot.interval),
        format_duration(rounded(plot.window))
    );
    let dropped = if plot.missed > 0 { format!(" · {} readings dropped", plot.missed) } else { String::new() };
    frame.buffer_mut().set_style(title, theme.title());
    frame.render_widget(Paragraph::new(text + &dropped).style(theme.title()), title);
    frame.render_widget(Paragraph::new(KEYS), foot);
    let parts: Vec<_> = plot.series.iter().map(|series| plot.parts(series)).collect();
    let shown: Vec<Line<'_>> = plot
        .series
        .iter()
        .zip(&parts)
        .enumerate()
        .map(|(number, (series, parts))| {
            let mark = mark(plot, theme, number);
            values_line(series, mark, parts, theme.line(number), theme)
        })
        .collect();
    frame.render_widget(Paragraph::new(shown), values);
    draw_chart(plot, &parts, theme, is_ascii, chart, frame);
}

/// The character that a curve is drawn with, and that its label has: its number, if there are
/// several without colours.
fn mark(plot: &Plot, theme: Theme, number: usize) -> Option<char> {
    let is_marked = plot.series.len() > 1 && !theme.has_colours();
    u32::try_from(number + 1).ok().and_then(|number| char::from_digit(number, 10)).filter(|_| is_marked)
}

/// The last value of a line, and its extremes.
fn values_line<'p>(
    series: &Series,
    mark: Option<char>,
    parts: &[Vec<(f64, f64)>],
    style: Style,
    theme: Theme,
) -> Line<'p> {
    let value = series.value.as_ref().map_or("-".to_owned(), |value| printable(&value.to_string()).to_string());
    let unit = if series.unit.is_empty() { String::new() } else { format!(" {}", series.unit) };
    let label = mark.map_or_else(|| series.label.clone(), |mark| format!("{mark}  {}", series.label));
    let mut spans = vec![Span::styled(label, style), Span::styled(format!("  {value}{unit}"), theme.header())];
    if let Some((low, high)) = extremes(parts.iter().flatten()) {
        spans.push(Span::raw(format!("  min {}  max {}", shortened(low), shortened(high))));
    }
    if let Some(reason) = &series.reason {
        spans.push(Span::styled(format!("  {reason}"), theme.trouble()));
    }
    Line::from(spans)
}

fn draw_chart(
    plot: &Plot,
    parts: &[Vec<Vec<(f64, f64)>>],
    theme: Theme,
    is_ascii: bool,
    area: Rect,
    frame: &mut Frame<'_>,
) {
    let datasets = parts.iter().enumerate().flat_map(|(number, parts)| {
        let fallback = if is_ascii { Marker::Dot } else { Marker::Braille };
        let marker = mark(plot, theme, number).map_or(fallback, Marker::Custom);
        parts.iter().map(move |part| {
            Dataset::default().marker(marker).graph_type(GraphType::Line).style(theme.line(number)).data(part)
        })
    });
    let numbers = NumberAxis::new(extremes(parts.iter().flatten().flatten()));
    let window = rounded(plot.window);
    let ago = |time| format!("-{}", format_duration(rounded(time)));
    let times = if area.width >= 40 { vec![ago(window), ago(window / 2), "now".to_owned()] } else { Vec::new() };
    let chart = Chart::new(datasets.collect())
        .x_axis(Axis::default().bounds([-plot.window.as_secs_f64(), 0.0]).labels(times))
        .y_axis(Axis::default().bounds([numbers.low, numbers.high]).labels(numbers.labels(area.height >= 16)))
        .legend_position(None);
    frame.render_widget(chart, area);
}

/// Rounds a time to seconds from 10 s on.
fn rounded(time: std::time::Duration) -> std::time::Duration {
    if time.as_secs() >= 10 { std::time::Duration::from_secs(time.as_secs()) } else { time }
}

/// A number with at most six digits behind the point.
fn shortened(number: f64) -> String {
    let number = if number.abs() < 1e9 { (number * 1e6).round() / 1e6 } else { number };
    format!("{number:?}")
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use fatek::tag::TagValue;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use tokio::time::Instant;

    use super::*;

    fn plot(values: impl Iterator<Item = f64>) -> Plot {
        let start = Instant::now();
        let mut plot = Plot::new("level", vec![Series::new("level", "%")], Duration::from_secs(1), start);
        for (second, value) in (0..).zip(values) {
            plot.take(0, start + Duration::from_secs(second), Some(&TagValue::F64(value)), None);
            plot.advance(start + Duration::from_secs(second));
        }
        plot
    }

    fn screen(plot: &Plot, is_ascii: bool, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| draw(plot, Theme::new(false), is_ascii, frame)).unwrap();
        let cells: Vec<&str> = terminal.backend().buffer().content().iter().map(|cell| cell.symbol()).collect();
        let lines = cells.chunks(usize::from(width).max(1)).map(|line| line.concat().trim_end().to_owned());
        lines.collect::<Vec<_>>().join("\n")
    }

    #[test]
    fn a_plot_at_80_by_24_shows_line_axes_and_value() {
        let plot = plot((0..121).map(|second| f64::from(second % 40)));
        let shown = screen(&plot, false, 80, 24);
        assert_eq!(format!("{shown}\n"), include_str!("80x24.txt"), "\n{shown}");
    }

    #[test]
    fn several_curves_without_colours_are_drawn_as_their_numbers() {
        let start = Instant::now();
        let curves = ["low", "high"].map(|label| Series::new(label, "")).into();
        let mut plot = Plot::new("level", curves, Duration::from_secs(1), start);
        for second in 0..10 {
            let at = start + Duration::from_secs(second);
            plot.take(0, at, Some(&TagValue::U16(3)), None);
            plot.take(1, at, Some(&TagValue::U16(9)), None);
            plot.advance(at);
        }
        plot.miss(7);
        let shown = screen(&plot, true, 60, 16);
        let curve = |text: &str| shown.lines().position(|line| line.contains(text)).expect(&shown);
        assert!(curve("222") < curve("111"), "{shown}");
        assert!(shown.contains("\n1  low  3 ") && shown.contains("\n2  high  9 "), "{shown}");
        assert!(shown.contains(" · 7 readings dropped"), "{shown}");
    }

    #[test]
    fn every_size_and_number_can_be_drawn() {
        let numbers = |count| (0..count).map(f64::from).collect::<Vec<_>>();
        let odd = vec![f64::NAN, f64::INFINITY, f64::MIN, f64::MAX, f64::NEG_INFINITY];
        for values in [numbers(0), numbers(1), numbers(200), odd, vec![0.0, 5e-324]] {
            let plot = plot(values.into_iter());
            for width in (0..30).step_by(4).chain([1, 2, 80, 200]) {
                for height in (0..13).chain([16, 24, 60]) {
                    screen(&plot, height % 2 == 0, width, height);
                }
            }
        }
    }
}
