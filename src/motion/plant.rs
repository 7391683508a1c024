//! Feet that stand still while they stand.
//!
//! [`Footing`] finds the smallest smooth changes of pelvis and legs over the whole clip after which touching soles do not
//! slide. So nobody has to say where a foot is to stand, when its leg begins to go there, or how hip, knee, ankle and pelvis
//! share the way: where legs and path disagree (starts, stops) mostly the pelvis gives way, and what a bend turns a standing
//! foot against the body is shared by hip and ankle over the contact, not by the swing.
//!
//! After Kovar, Schreiner and Gleicher (2002), "Footskate cleanup for motion capture editing", SCA, whose steps (foot places,
//! root, two-bone legs, knee damping, blending into the neighbouring frames) are the terms of one least-squares problem here,
//! as in Gleicher's (1997) spacetime constraints. Legs keep their length; the trunk above the pelvis keeps its joints.
//! Takes 30 kB and about a millisecond per frame.
//! Fails when: a generated foot slides farther than pelvis and leg can undo; it then still slides and is counted.
//! Checked against generated walks, runs, starts, stops and bends of invented and recorded people, whose feet are followed by forward kinematics.

use std::ops::Range;

use super::contact::FootTrack;
use super::footing::{Footing, LEGS, UNKNOWNS};
use crate::body::Clip;
use crate::math::arrow::{LmOptions, minimise};

/// A foot that drifts less over a contact stands.
const STILL_M: f64 = 0.005;
/// The problem is nearly linear: more iterations change less than a tenth of a millimetre.
const SOLVE: LmOptions = LmOptions { max_iterations: 20, relative_cost: 1e-4 };

/// A clip with its feet planted.
#[derive(Clone, Debug)]
pub struct Planted {
    pub clip: Clip,
    /// Frames in which the left and the right foot stand.
    pub contacts: [Vec<Range<usize>>; 2],
    /// How far the foot still drifts in each contact, metres ([`FootTrack::drift_m`]).
    pub drifts_m: [Vec<f64>; 2],
}

impl Planted {
    /// Contacts whose foot still drifts by more than 5 mm.
    pub fn sliding(&self) -> usize {
        self.drifts_m.iter().flatten().filter(|d| **d > STILL_M).count()
    }

    /// The largest drift, metres.
    pub fn farthest_m(&self) -> f64 {
        self.drifts_m.iter().flatten().copied().fold(0.0, f64::max)
    }
}

/// Plants the feet of a clip whose floor is y = 0.
pub fn plant_feet(clip: &Clip) -> Planted {
    let tracks = LEGS.map(|leg| FootTrack::new(clip, leg[2]));
    let contacts = tracks.each_ref().map(|foot| foot.contacts(clip));
    let footing = Footing::new(clip, &tracks, &contacts);
    let mut changes = vec![[0.0; UNKNOWNS]; clip.poses.len()];
    if contacts.iter().any(|c| !c.is_empty()) {
        changes = minimise(&footing, changes, &SOLVE).0;
    }
    let poses = changes.iter().enumerate().map(|(frame, x)| footing.pose(frame, x)).collect();
    let planted = Clip { poses, ..clip.clone() };
    let drifts_m = [0, 1].map(|side: usize| {
        let foot = FootTrack::new(&planted, LEGS[side][2]);
        contacts[side].iter().map(|c| foot.drift_m(c.clone())).collect()
    });
    Planted { clip: planted, contacts, drifts_m }
}
