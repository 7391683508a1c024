//! Pictures people look at.
