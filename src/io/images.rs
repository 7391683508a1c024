//! Pictures as PNG and JPEG, grey.
//!
//! Decoders return the part of a truncated JPEG that they have, with a grey rest, so the end markers are looked for:
//! EOI (FF D9) for JPEG, the IEND chunk for PNG, each with nothing but padding after it.
//! Colour becomes Y = 0.299 R + 0.587 G + 0.114 B as in OpenCV, against which the decoding is checked.

use image::{DynamicImage, GrayImage, ImageFormat};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

const PNG_END: [u8; 8] = *b"IEND\xae\x42\x60\x82";
const JPEG_END: [u8; 2] = [0xff, 0xd9];
/// Padding after the end of a picture that is still looked through, bytes.
const LONGEST_PADDING: u64 = 4096;

/// Why a picture cannot be used; every message names the file.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    #[error("{}: cannot be read: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error("{}: is neither a PNG nor a JPEG picture", path.display())]
    Format { path: PathBuf },
    #[error("{}: is truncated, its end is missing; copy it again", path.display())]
    Truncated { path: PathBuf },
    #[error("{}: is damaged ({message}); copy it again", path.display())]
    Damaged { path: PathBuf, message: String },
}

/// Whether the file name says PNG or JPEG.
pub fn is_image_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    ["png", "jpg", "jpeg"].contains(&extension.as_str())
}

/// Reads a whole picture as grey.
pub fn read_grey(path: &Path) -> Result<GrayImage, ImageError> {
    read_any(path).map(grey)
}

/// Reads a whole picture as it is.
pub fn read_any(path: &Path) -> Result<DynamicImage, ImageError> {
    let bytes = std::fs::read(path).map_err(|error| ImageError::Read { path: path.into(), error })?;
    let format = format_of(path, &bytes)?;
    if !ends_whole(&bytes, format) {
        return Err(ImageError::Truncated { path: path.into() });
    }
    let damaged = |e: image::ImageError| ImageError::Damaged { path: path.into(), message: e.to_string().replace('\n', ", ") };
    image::load_from_memory_with_format(&bytes, format).map_err(damaged)
}

/// Looks at the first and last bytes of a picture only, and refuses one that is no picture or has lost its end.
pub fn check_ends(path: &Path) -> Result<(), ImageError> {
    let (head, tail) = head_and_tail(path).map_err(|error| ImageError::Read { path: path.into(), error })?;
    let format = format_of(path, &head)?;
    if ends_whole(&tail, format) { Ok(()) } else { Err(ImageError::Truncated { path: path.into() }) }
}

fn head_and_tail(path: &Path) -> std::io::Result<(Vec<u8>, Vec<u8>)> {
    let mut file = File::open(path)?;
    let (mut head, mut tail) = (Vec::new(), Vec::new());
    Read::by_ref(&mut file).take(16).read_to_end(&mut head)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(LONGEST_PADDING)))?;
    file.read_to_end(&mut tail)?;
    Ok((head, tail))
}

fn format_of(path: &Path, bytes: &[u8]) -> Result<ImageFormat, ImageError> {
    match image::guess_format(bytes) {
        Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg)) => Ok(format),
        _ => Err(ImageError::Format { path: path.into() }),
    }
}

fn ends_whole(bytes: &[u8], format: ImageFormat) -> bool {
    let end = bytes.iter().rposition(|b| ![0x00, 0xff, b'\n', b'\r', b' '].contains(b)).map_or(0, |last| last + 1);
    let mark: &[u8] = if format == ImageFormat::Png { &PNG_END } else { &JPEG_END };
    bytes[..end].ends_with(mark)
}

fn grey(image: DynamicImage) -> GrayImage {
    match image {
        DynamicImage::ImageLuma8(grey) => grey,
        DynamicImage::ImageLuma16(_) | DynamicImage::ImageLumaA8(_) | DynamicImage::ImageLumaA16(_) => image.into_luma8(),
        colour => {
            let colour = colour.into_rgb8();
            GrayImage::from_fn(colour.width(), colour.height(), |x, y| {
                let [r, g, b] = colour.get_pixel(x, y).0.map(u32::from);
                image::Luma([((299 * r + 587 * g + 114 * b + 500) / 1000) as u8])
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::imgcodecs;
    use opencv::prelude::*;

    fn opencv_grey(path: &Path) -> GrayImage {
        let mat = imgcodecs::imread(path, imgcodecs::IMREAD_GRAYSCALE).unwrap();
        GrayImage::from_raw(mat.cols() as u32, mat.rows() as u32, mat.data_bytes().unwrap().to_vec()).unwrap()
    }

    fn largest_difference(a: &GrayImage, b: &GrayImage) -> u8 {
        assert_eq!(a.dimensions(), b.dimensions());
        a.iter().zip(b.iter()).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
    }

    fn colours() -> image::RgbImage {
        image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(4 * x) as u8, (5 * y) as u8, (255 - 2 * (x + y)) as u8]))
    }

    #[test]
    fn pictures_decode_as_opencv_decodes_them() {
        let folder = tempfile::tempdir().unwrap();
        for (name, tolerance) in [("colour.png", 1), ("colour.jpg", 3)] {
            let path = folder.path().join(name);
            colours().save(&path).unwrap();
            let ours = read_grey(&path).unwrap();
            assert!(largest_difference(&ours, &opencv_grey(&path)) <= tolerance, "{name}");
            assert!(ours.get_pixel(63, 47).0[0].abs_diff(ours.get_pixel(0, 0).0[0]) > 100);
        }
    }

    #[test]
    fn real_footage_decodes_as_opencv_decodes_it() {
        let session = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/footage/p12_walk_lab");
        if !session.exists() {
            println!("skipped: no {}", session.display());
            return;
        }
        for (name, tolerance) in [("cam_00/000000.jpg", 1), ("cam_02/000031.jpg", 1), ("cam_01_background.png", 0)] {
            let path = session.join(name);
            assert!(largest_difference(&read_grey(&path).unwrap(), &opencv_grey(&path)) <= tolerance, "{name}");
        }
    }

    #[test]
    fn truncation_is_found_wherever_it_happens_and_padding_is_allowed() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.png", "a.jpg"] {
            let path = folder.path().join(name);
            colours().save(&path).unwrap();
            let whole = std::fs::read(&path).unwrap();
            let expected = read_grey(&path).unwrap();
            for cut in (20..whole.len()).step_by(7).chain([whole.len() - 1]) {
                std::fs::write(&path, &whole[..cut]).unwrap();
                assert!(matches!(read_grey(&path), Err(ImageError::Truncated { .. })), "{name} cut at {cut}");
                assert!(matches!(check_ends(&path), Err(ImageError::Truncated { .. })), "{name} cut at {cut}");
            }
            std::fs::write(&path, [&whole[..], &[0; 2000]].concat()).unwrap();
            assert!(check_ends(&path).is_ok());
            assert_eq!(read_grey(&path).unwrap(), expected);
        }
    }

    #[test]
    fn damage_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        colours().save(&path).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x55;
        std::fs::write(&path, bytes).unwrap();
        assert!(matches!(read_grey(&path), Err(ImageError::Damaged { .. })));
        std::fs::write(&path, "no picture").unwrap();
        assert!(read_grey(&path).unwrap_err().to_string().contains("a.png: is neither"));
        assert!(matches!(read_grey(&folder.path().join("b.png")), Err(ImageError::Read { .. })));
    }
}
