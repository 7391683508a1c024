//! Simultaneous images with times, synchronization check, foreground.
