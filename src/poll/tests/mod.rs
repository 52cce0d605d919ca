mod cycles;
mod lab;
mod quality;
mod refusals;
mod review;
mod seeded;
