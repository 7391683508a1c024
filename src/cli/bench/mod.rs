//! `muybridge bench`: tables of accuracy and time beside OpenCV's, in the same process.

mod animal;
mod people;
mod stereo;

use anyhow::Result;

#[derive(clap::Subcommand)]
pub enum BenchCommand {
    /// The animal paper's synthetic study: angle errors by keys and components, on an ellipsoid horse and on rigs
    Animal(animal::AnimalArgs),
    /// Clouds of people against the true depths and masks of rendered sessions, beside OpenCV's StereoSGBM
    Clouds(people::PeopleArgs),
    /// Disparities of Middlebury's pairs and the time they take, beside OpenCV's StereoBM and StereoSGBM
    Stereo(stereo::StereoArgs),
}

pub fn run(command: &BenchCommand) -> Result<()> {
    match command {
        BenchCommand::Animal(args) => animal::run(args),
        BenchCommand::Clouds(args) => people::run(args),
        BenchCommand::Stereo(args) => stereo::run(args),
    }
}
