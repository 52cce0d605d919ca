//! Programs in files, with their frame or as bare bytes.

use fatek::Program;

use crate::saved;

pub fn run(input: &[u8]) {
    if let Ok(program) = Program::from_bytes(input) {
        assert_eq!(program.to_bytes(), input);
        comes_back(&program);
    }
    let file = saved::file("program", input);
    match Program::from_file(&file) {
        Ok(program) => {
            assert!(program.to_bytes().len() < file.len(), "no more than the file holds");
            comes_back(&program);
        }
        Err(error) => assert_ne!(error.to_string(), ""),
    }
}

fn comes_back(program: &Program) {
    let again = Program::from_file(program.to_file().as_bytes());
    assert_eq!(again.as_ref(), Ok(program));
}
