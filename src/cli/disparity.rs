//! `muybridge disparity`: one rectified pair or triple.

use anyhow::{Context, Result, bail};
use image::GrayImage;
use muybridge::clouds::correlate::MOST_HYPOTHESES;
use muybridge::clouds::stereo::{StereoOptions, StereoView, disparity_map};
use muybridge::io::pfm::write_pfm;
use muybridge::rig::rectify::Plane;
use nalgebra::Vector2;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
pub struct DisparityArgs {
    /// Rectified left picture, grey or colour.
    #[arg(long)]
    left: PathBuf,
    /// Rectified right picture.
    #[arg(long)]
    right: PathBuf,
    /// A third picture, rectified together with the others.
    #[arg(long, requires = "third_baseline")]
    third: Option<PathBuf>,
    /// Place of the third camera in units of the left-right baseline, x right and y down: 0,1 is an L's other arm, 2,0 a further
    /// camera in a row, -1,0 one on the other side.
    #[arg(long, value_name = "X,Y", allow_hyphen_values = true, requires = "third", value_parser = two_numbers)]
    third_baseline: Option<[f64; 2]>,
    /// Disparities between left and right are sought below this, pixels.
    #[arg(long, value_parser = clap::value_parser!(u16).range(2..=4096))]
    max_disparity: u16,
    /// Portable float map: the left view's disparities in pixels, infinity where there is none.
    #[arg(short, long)]
    output: PathBuf,
}

fn two_numbers(text: &str) -> Result<[f64; 2], String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect();
    match numbers.as_deref() {
        Some(&[x, y]) if x != 0.0 || y != 0.0 => Ok([x, y]),
        _ => Err(format!("'{text}' is not a place X,Y other than 0,0")),
    }
}

pub fn run(args: &DisparityArgs) -> Result<()> {
    let left = read_grey(&args.left)?;
    let right = read_grey(&args.right)?;
    let mut views = vec![(&args.left, left, Vector2::zeros()), (&args.right, right, Vector2::new(-1.0, 0.0))];
    if let (Some(path), Some([x, y])) = (&args.third, args.third_baseline) {
        views.push((path, read_grey(path)?, Vector2::new(-x, -y)));
    }
    let size = views[0].1.dimensions();
    if let Some((path, image, _)) = views.iter().find(|v| v.1.dimensions() != size) {
        let (w, h) = image.dimensions();
        bail!(
            "{} is {w}x{h} pixels but {} is {}x{}; rectified pictures have one size",
            path.display(),
            args.left.display(),
            size.0,
            size.1
        );
    }
    let longest = views.iter().map(|v| v.2.amax()).fold(1.0, f64::max);
    if f64::from(args.max_disparity) * longest > MOST_HYPOTHESES as f64 {
        let most = (MOST_HYPOTHESES as f64 / longest) as usize;
        bail!("--max-disparity {} is more than can be searched with these baselines; give at most {most}", args.max_disparity);
    }
    let views: Vec<StereoView> = views.iter().map(|(_, image, step)| StereoView { plane: plane(image), step: *step }).collect();
    let range = [0, usize::from(args.max_disparity) - 1];
    Ok(write_pfm(&args.output, &disparity_map(&views, range, &StereoOptions::default()))?)
}

fn read_grey(path: &Path) -> Result<GrayImage> {
    Ok(image::open(path).with_context(|| format!("cannot read the picture {}", path.display()))?.into_luma8())
}

fn plane(image: &GrayImage) -> Plane {
    Plane::from_fn(image.width(), image.height(), |x, y| image::Luma([f32::from(image.get_pixel(x, y).0[0])]))
}
