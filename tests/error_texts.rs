//! Errors that quote their input: one line, and 200 characters of it at most.

use fatek::command::{ReadStatus, decode_reply};
use fatek::file::{FileError, FormatError};
use fatek::tag::{Assignment, Scale, TagType};
use fatek::wire::Framing;
use fatek::{Backup, Element, Endpoint, Program, Tag};

/// The error of each parser of texts.
fn errors(text: &str) -> Vec<String> {
    fn error<T: std::str::FromStr<Err: std::fmt::Display> + std::fmt::Debug>(text: &str) -> String {
        text.parse::<T>().unwrap_err().to_string()
    }
    let url = |start: &str| error::<Endpoint>(&format!("{start}{text}"));
    let file = |start: &str| format!("{start}{text}\n").into_bytes();
    let path = std::path::PathBuf::from(text);
    vec![
        error::<Element>(text),
        error::<Element>(&format!("R{text}")),
        error::<Tag>(text),
        error::<Tag>(&format!("R0-{text}")),
        error::<Tag>(&format!("R0:{text}")),
        error::<Tag>(&format!("R0:i16*{text}")),
        error::<TagType>(text),
        error::<Scale>(text),
        error::<Framing>(text),
        error::<Assignment>(text),
        error::<Assignment>(&format!("R0={text}")),
        error::<Assignment>(&format!("R0-R1:text={text}")),
        error::<Assignment>(&format!("R0-R1:text=\"{text}")),
        url(""),
        url("x"),
        url("tcp://"),
        url("tcp://h:"),
        url("tcp://["),
        url("tcp://[::1]"),
        url("tcp://h?"),
        url("tcp://h?framing="),
        url("tcp://h?copies="),
        url("tcp://h?settle="),
        url("tcp://h?one_request="),
        url("serial:x?baud="),
        url("serial:x?frame="),
        url("serial:x?framing="),
        error::<Endpoint>(&format!("{text}://h")),
        error::<Endpoint>(&format!("tcp://[{text}]")),
        Program::from_file(&file("fatek file 1: ")).unwrap_err().to_string(),
        Program::from_file(&file("fatek file ")).unwrap_err().to_string(),
        Backup::from_file(&file("fatek file 1: ")).unwrap_err().to_string(),
        FormatError::clone(&Backup::from_file(&file("")).unwrap_err()).to_string(),
        match Program::load(&path) {
            Err(error @ FileError::Io { .. }) => error.to_string(),
            other => panic!("{other:?}"),
        },
    ]
}

// Before: 30 of these 34 had the whole text, some of them twice, with ESC and U+202E as they are.
#[test]
fn an_error_quotes_200_characters_without_controls() {
    let long = format!("\x1b[31m\u{9b}\u{202e}\n{}", "q\u{7f}".repeat(50_000));
    for (number, error) in errors(&long).into_iter().enumerate() {
        let length = error.chars().count();
        assert!(length < 2500, "{number}: {length} characters: {error}");
        assert!(!error.contains(|c: char| c.is_control() || c == '\u{202e}'), "{number}: {error:?}");
        assert!(error.matches('q').count() <= 3 * 100, "{number}: {error}");
    }
}

#[test]
fn a_short_text_is_quoted_whole() {
    let error = "tcp://a b".parse::<Endpoint>().unwrap_err();
    assert!(error.to_string().starts_with("`tcp://a b` is not an endpoint: the host `a b` has "), "{error}");
    let error = "R0:i17".parse::<Tag>().unwrap_err();
    assert!(error.to_string().contains("`R0:i17` is not a tag"), "{error}");
}

/// The texts of an error and its sources.
fn chain(error: &(dyn std::error::Error + 'static)) -> Vec<String> {
    std::iter::successors(Some(error), |&error| error.source()).map(ToString::to_string).collect()
}

/// Before: the errors of files, programs and backups had their source in the text and as
/// `source()`, so that programs that print the chain printed it twice or three times.
#[tokio::test]
async fn no_error_repeats_the_text_of_its_source() {
    let refused = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let link = fatek::Link::builder(Endpoint::from(refused)).fail_fast(true).build();
    let station = link.station(1).unwrap();
    let tags = ["R0-R9".parse::<Tag>().unwrap()];
    let folder = std::env::temp_dir().join(format!("fatek-chain-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let damaged = folder.join("damaged");
    std::fs::write(&damaged, "fatek file 1: program\n").unwrap();
    let page = fatek::command::ProgramPage::new([0; fatek::command::PAGE_WORDS]);
    let fixture = |name: &str| std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name);
    let program = Program::load(fixture("program-1.program")).unwrap();
    let backup = Backup::load(fixture("backup-1.backup")).unwrap();
    let chains = [
        chain(&Program::load(folder.join("missing")).unwrap_err()),
        chain(&Program::load(&damaged).unwrap_err()),
        chain(&fatek::program::ReadProgram::new().run(&station).await.unwrap_err()),
        chain(&fatek::backup::TakeBackup::new(tags).unwrap().run(&station).await.unwrap_err()),
        chain(&station.read_registers(fatek::register!("R0"), 1).await.unwrap_err()),
        chain(&fatek::program::WriteProgram::new(&program, Default::default()).run(&station).await.unwrap_err()),
        chain(&fatek::backup::Restore::new(&backup, Default::default()).run(&station).await.unwrap_err()),
        chain(&station.write("R0", 70_000).await.unwrap_err()),
        chain(&decode_reply(&ReadStatus, Framing::Ascii, b"0").unwrap_err()),
        chain(&Program::from_pages([page].into()).unwrap_err()),
    ];
    std::fs::remove_dir_all(&folder).unwrap();
    for texts in chains {
        for (n, text) in texts.iter().enumerate() {
            assert!(!texts[..n].iter().any(|before| before.contains(text)), "{texts:?}");
        }
        assert!(!texts[0].is_empty());
    }
}
