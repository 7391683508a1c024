//! A known body and stage before a known rig, ray-cast to images: truth for tests and for the demo.
