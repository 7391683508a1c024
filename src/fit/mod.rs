//! Fitting the body to all clouds at once.
