//! Style: projection onto the model, distances, weights (style paper §4).
