mod cycles;
mod duplicates;
mod lab;
mod quality;
mod refusals;
mod regressions;
mod seeded;
