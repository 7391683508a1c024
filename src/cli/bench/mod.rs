//! `muybridge bench`: tables of accuracy and time beside OpenCV's, in the same process.

mod animal;
mod coverage;
mod fit;
mod headline;
mod people;
mod stereo;
mod sweeps;
mod takes;

use anyhow::Result;

#[derive(clap::Subcommand)]
pub enum BenchCommand {
    /// The animal paper's synthetic study: angle errors by keys and components, on an ellipsoid horse and on rigs
    Animal(animal::AnimalArgs),
    /// Clouds of people against the true depths and masks of rendered sessions, beside OpenCV's StereoSGBM
    Clouds(people::PeopleArgs),
    /// Disparities of Middlebury's pairs and the time they take, beside OpenCV's StereoBM and StereoSGBM
    Stereo(stereo::StereoArgs),
    /// What each ingredient of the fit is worth on sessions with known joints
    Fit(fit::FitArgs),
    /// The fit on phantoms over noise, rigs, frame rates, lost frames, clutter and headings, and on random walks
    Sweeps(sweeps::SweepsArgs),
    /// Recorded people filmed by the phantom, tracked, and generated at their other speeds
    Headline(headline::HeadlineArgs),
    /// How often the fit's 95 % intervals hold the truth
    Coverage(coverage::CoverageArgs),
}

pub fn run(command: &BenchCommand) -> Result<()> {
    match command {
        BenchCommand::Animal(args) => animal::run(args),
        BenchCommand::Clouds(args) => people::run(args),
        BenchCommand::Stereo(args) => stereo::run(args),
        BenchCommand::Fit(args) => fit::run(args),
        BenchCommand::Sweeps(args) => sweeps::run(args),
        BenchCommand::Headline(args) => headline::run(args),
        BenchCommand::Coverage(args) => coverage::run(args),
    }
}
