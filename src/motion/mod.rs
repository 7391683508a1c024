//! Motion synthesis at a wanted parameter, playback, retargeting.
