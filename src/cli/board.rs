//! `muybridge rig board`: a calibration board to print.

use anyhow::{Result, bail};
use muybridge::footage::board::Board;
use muybridge::report::board::{save_png, save_svg};
use std::path::PathBuf;

/// The board's description, as `calibrate` and `rig board` take it.
#[derive(clap::Args)]
pub struct BoardOptions {
    /// Inner corners across and down, one less than the squares; with --charuco the squares
    #[arg(long, value_name = "9x6", value_parser = two_counts)]
    board: [usize; 2],
    /// Side of a square, metres
    #[arg(long, value_name = "M", value_parser = super::positive)]
    square: f64,
    /// A ChArUco board with markers of this dictionary, such as 4X4_50
    #[arg(long, value_name = "DICTIONARY", requires = "marker")]
    charuco: Option<String>,
    /// Side of a ChArUco board's markers, metres
    #[arg(long, value_name = "M", requires = "charuco", value_parser = super::positive)]
    marker: Option<f64>,
}

impl BoardOptions {
    /// The board; `inverted` for ChArUco boards that are printed as a negative.
    pub fn board(&self, inverted: bool) -> Result<Board> {
        Ok(match (&self.charuco, self.marker) {
            (Some(dictionary), Some(marker)) => Board::charuco(self.board, self.square, marker, dictionary, inverted)?,
            _ => Board::chessboard(self.board[0], self.board[1], self.square)?,
        })
    }
}

fn two_counts(text: &str) -> Result<[usize; 2], String> {
    let numbers: Option<Vec<usize>> = text.split(['x', 'X']).map(|n| n.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[columns, rows]) => Ok([columns, rows]),
        _ => Err(format!("'{text}' is not a size such as 9x6")),
    }
}

#[derive(clap::Args)]
pub struct BoardArgs {
    #[command(flatten)]
    options: BoardOptions,
    /// File to write: .png (about 300 dpi) or .svg
    #[arg(short, long)]
    output: PathBuf,
}

pub fn run(args: &BoardArgs) -> Result<()> {
    let board = args.options.board(false)?;
    let extension = args.output.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    match extension.as_str() {
        "png" => save_png(&args.output, &board)?,
        "svg" => save_svg(&args.output, &board)?,
        _ => bail!("{}: boards are written as .png or .svg", args.output.display()),
    }
    println!("{board}, in {}; print it at 100 % and measure it", args.output.display());
    Ok(())
}
