//! Pictures as PNG and JPEG, grey.
//!
//! Decoders return the part of a truncated JPEG that they have, with a grey rest, so the end markers are looked for:
//! EOI (FF D9) for JPEG, the IEND chunk for PNG, each with nothing but padding after it.
//! Colour becomes Y = 0.299 R + 0.587 G + 0.114 B as in OpenCV, against which the decoding is checked.

use image::{DynamicImage, GrayImage, ImageDecoder, ImageFormat, ImageReader};
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

const PNG_END: [u8; 8] = *b"IEND\xae\x42\x60\x82";
const JPEG_END: [u8; 2] = [0xff, 0xd9];
/// Padding after the end of a picture that is still looked through, bytes.
const LONGEST_PADDING: u64 = 4096;

/// More bytes of pixels than this come from no byte of a file: deflate makes 1032 of one, JPEG a block from a bit.
const UNPACKED: u64 = 1100;

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
    let damaged = |message: String| ImageError::Damaged { path: path.into(), message };
    let failed = |e: image::ImageError| damaged(e.to_string().replace('\n', ", "));
    let decoder = ImageReader::with_format(Cursor::new(&bytes), format).into_decoder().map_err(failed)?;
    if decoder.total_bytes() > UNPACKED * bytes.len() as u64 {
        let (width, height) = decoder.dimensions();
        return Err(damaged(format!("{} bytes cannot hold the {width}x{height} pixels that it promises", bytes.len())));
    }
    DynamicImage::from_decoder(decoder).map_err(failed)
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

    /// A header is changed with its checksum; what follows are the pixels of a small picture.
    #[test]
    fn a_header_that_promises_more_than_the_file_can_hold_takes_no_room() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let whole = GrayImage::from_pixel(2000, 1500, image::Luma([7]));
        whole.save(&path).unwrap();
        assert_eq!(read_grey(&path).unwrap(), whole, "an even picture packs best of all");
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0x75, 0x30, 0, 0, 0x42, 0x68]);
        let check = crc(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&check.to_be_bytes());
        std::fs::write(&path, &bytes).unwrap();
        let error = read_grey(&path).unwrap_err().to_string();
        assert!(error.contains("cannot hold the 30000x17000 pixels that it promises"), "{error}");
    }

    /// PNG's checksum (CRC-32).
    fn crc(bytes: &[u8]) -> u32 {
        let step = |c: u32, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 };
        !bytes.iter().fold(!0u32, |c, b| (0..8).fold(c ^ u32::from(*b), step))
    }
}
