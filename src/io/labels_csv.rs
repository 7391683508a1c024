//! Labels of motions: a table whose column `file` names a motion and whose other columns are attributes.
//!
//! `file` is a motion's file name, with or without its ending, or a motion's name in the space (`walk#2`); empty cells are unknown.

use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum LabelsError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path} line 1 names no column `file`, or no attribute beside it")]
    Columns { path: PathBuf },
    #[error("{path} line 1 names the column `{column}` twice")]
    Twice { path: PathBuf, column: String },
    #[error("{path} line {line}: {why}")]
    Row { path: PathBuf, line: usize, why: String },
}

/// What a table says of one motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Line of the table, from 1.
    pub line: usize,
    pub motion: String,
    /// In the order of [`Labels::attributes`].
    pub values: Vec<Option<f64>>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Labels {
    pub attributes: Vec<String>,
    pub rows: Vec<Row>,
}

impl Labels {
    /// The row for a motion called `name` (`walk#2`) of the file `file` (`walk.bvh`): its own, or its file's.
    pub fn of(&self, name: &str, file: &str) -> Option<&Row> {
        let stem = Path::new(file).file_stem().unwrap_or_default().to_string_lossy();
        self.rows.iter().find(|r| r.motion == name).or_else(|| self.rows.iter().find(|r| r.motion == file || r.motion == *stem))
    }
}

pub fn read_labels(path: &Path) -> Result<Labels, LabelsError> {
    let text = std::fs::read_to_string(path).map_err(|cause| LabelsError::Read { path: path.into(), cause })?;
    let cells = |line: &str| line.split(',').map(|c| c.trim().trim_matches('"').to_string()).collect::<Vec<String>>();
    let mut lines = text.trim_start_matches('\u{feff}').lines();
    let columns = cells(lines.next().unwrap_or_default());
    let file = columns.iter().position(|c| c == "file").filter(|_| columns.len() > 1);
    let file = file.ok_or(LabelsError::Columns { path: path.into() })?;
    if let Some(i) = (1..columns.len()).find(|&i| columns[..i].contains(&columns[i])) {
        return Err(LabelsError::Twice { path: path.into(), column: columns[i].clone() });
    }
    let mut rows = Vec::new();
    for (i, line) in lines.enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let row = row(&columns, file, cells(line), i + 2);
        rows.push(row.map_err(|why| LabelsError::Row { path: path.into(), line: i + 2, why })?);
    }
    let attributes = columns.into_iter().enumerate().filter(|(i, _)| *i != file).map(|(_, c)| c).collect();
    Ok(Labels { attributes, rows })
}

fn row(columns: &[String], file: usize, cells: Vec<String>, line: usize) -> Result<Row, String> {
    if cells.len() > columns.len() {
        return Err(format!("has {} cells, the header {}", cells.len(), columns.len()));
    }
    let motion = cells.get(file).filter(|c| !c.is_empty()).ok_or("names no file")?.clone();
    let value = |column: usize| -> Result<Option<f64>, String> {
        let Some(cell) = cells.get(column).filter(|c| !c.is_empty()) else { return Ok(None) };
        let number = cell.parse().ok().filter(|v: &f64| v.is_finite());
        number.map(Some).ok_or(format!("{} is `{cell}`, not a number", columns[column]))
    };
    let values = (0..columns.len()).filter(|&c| c != file).map(value).collect::<Result<_, _>>()?;
    Ok(Row { line, motion, values })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Labels, LabelsError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("labels.csv");
        std::fs::write(&path, text).unwrap();
        read_labels(&path)
    }

    #[test]
    fn finds_a_motions_own_row_before_its_files() {
        let labels = read("mood,file,age\n1,walk.bvh,\n-2.5,walk#2,30\n,run,7\n").unwrap();
        assert_eq!(labels.attributes, ["mood", "age"]);
        let of = |name: &str, file: &str| labels.of(name, file).map(|r| r.values.clone());
        assert_eq!(of("walk#1", "walk.bvh").unwrap(), [Some(1.0), None]);
        assert_eq!(of("walk#2", "walk.bvh").unwrap(), [Some(-2.5), Some(30.0)]);
        assert_eq!(of("run", "run.amc").unwrap(), [None, Some(7.0)]);
        assert_eq!(of("hop", "hop.bvh"), None);
    }

    #[test]
    fn errors_name_the_line() {
        let cases = [
            ("mood\n1\n", "no column `file`"),
            ("file\na\n", "no attribute beside it"),
            ("file,a,a\n", "`a` twice"),
            ("file,a\n\nx,gay\n", "line 3: a is `gay`, not a number"),
            ("file,a\nx,inf\n", "line 2"),
            ("file,a\n,1\n", "names no file"),
            ("file,a\nx,1,2\n", "has 3 cells, the header 2"),
        ];
        for (text, part) in cases {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("labels.csv"), "{message}");
        }
    }
}
