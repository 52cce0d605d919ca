mod cycles;
mod lab;
mod quality;
mod refusals;
mod regressions;
mod seeded;
