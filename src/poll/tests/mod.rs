mod cycles;
mod duplicates;
mod quality;
mod random;
mod refusals;
mod regressions;
mod rig;
mod words;
