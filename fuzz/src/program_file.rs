//! Program files, and raw program files.

use fatek::Program;

use crate::saved;

pub fn run(input: &[u8]) {
    if let Ok(program) = Program::from_bytes(input) {
        assert_eq!(program.to_bytes(), input);
        round_trips(&program);
    }
    let file = saved::file("program", input);
    match Program::from_file(&file) {
        Ok(program) => {
            assert!(program.to_bytes().len() < file.len(), "the program is smaller than its file");
            round_trips(&program);
        }
        Err(error) => assert_ne!(error.to_string(), ""),
    }
}

fn round_trips(program: &Program) {
    let again = Program::from_file(program.to_file().as_bytes());
    assert_eq!(again.as_ref(), Ok(program));
}
