//! What a joint's or a marker's name says: the part of the body, and the side.
//!
//! A name is cut into words at separators, digits and capitals; decorations of exporters in front of the body's words
//! (`mixamorig_`, `CC_Base_`, `J_Bip_`) and behind them (`_JNT`, `.001`) are ignored. A new naming scheme is a new
//! word in [`WORDS`].

use crate::Side;

/// A part of the body that a name tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    Pelvis,
    Collar,
    /// The collar or the upper arm: schemes differ.
    Shoulder,
    UpperArm,
    Elbow,
    Wrist,
    Hand,
    Thumb,
    Index,
    Little,
    /// Any other finger.
    Finger,
    Thigh,
    /// The thigh or the shin: schemes differ.
    Leg,
    Knee,
    Ankle,
    Toe,
}

/// What a name says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Named {
    pub(crate) side: Option<Side>,
    pub(crate) part: Option<Part>,
}

/// Words of the body in lower case, compound ones in one word.
const WORDS: &[(Part, &[&str])] = &[
    (
        Part::Pelvis,
        &[
            "hips",
            "pelvis",
            "hip",
            "hipcenter",
            "hipcentre",
            "spinebase",
            "センター",
            "下半身",
        ],
    ),
    (
        Part::Collar,
        &[
            "clavicle",
            "collar",
            "collarbone",
            "clav",
            "scapula",
            "innershoulder",
            "sternoclavicular",
            "肩",
        ],
    ),
    (Part::Shoulder, &["shoulder", "shldr"]),
    (
        Part::UpperArm,
        &[
            "arm",
            "upperarm",
            "uparm",
            "uarm",
            "armupper",
            "humerus",
            "shldrbend",
            "bicep",
            "glenohumeral",
            "腕",
        ],
    ),
    (
        Part::Elbow,
        &[
            "forearm",
            "farm",
            "lowerarm",
            "lowarm",
            "armlower",
            "elbow",
            "radius",
            "ulna",
            "forearmbend",
            "ひじ",
            "肘",
        ],
    ),
    (Part::Wrist, &["wrist", "carpus", "手首"]),
    (Part::Hand, &["hand", "palm", "手"]),
    (Part::Thumb, &["thumb", "pollex"]),
    (
        Part::Index,
        &["index", "indexfinger", "handindex", "point", "finger1"],
    ),
    (
        Part::Little,
        &["pinky", "pinkie", "little", "littlefinger", "handpinky"],
    ),
    (
        Part::Finger,
        &["middle", "ring", "finger", "fingers", "mid", "fingerbase"],
    ),
    (
        Part::Thigh,
        &[
            "upleg",
            "upperleg",
            "thigh",
            "thighbend",
            "uleg",
            "legupper",
            "femur",
            "足",
        ],
    ),
    (Part::Leg, &["leg"]),
    (
        Part::Knee,
        &[
            "lowleg", "lowerleg", "leglower", "shin", "calf", "knee", "tibia", "crus", "shank",
            "ひざ",
        ],
    ),
    (Part::Ankle, &["foot", "ankle", "足首"]),
    (
        Part::Toe,
        &["toe", "toes", "toebase", "ball", "football", "forefoot"],
    ),
];

/// Words that say nothing about the body, wherever they stand.
const DECORATIONS: &[&str] = &[
    "jnt", "joint", "bind", "bone", "def", "skin", "skel", "jt", "bn", "geo",
];

/// How left and right are written.
const SIDES: [&[&str]; 2] = [
    &[
        "left",
        "l",
        "lft",
        "lt",
        "左",
        "gauche",
        "links",
        "izquierdo",
        "izquierda",
    ],
    &[
        "right", "r", "rgt", "rt", "右", "droit", "droite", "rechts", "derecho", "derecha",
    ],
];

/// A body word has at most this many words of a name.
const LONGEST: usize = 3;

/// Reads a name.
pub(crate) fn parse(name: &str) -> Named {
    let mut words = words(name);
    // A hip joint of its own above the thigh, as in the CMU skeletons, is neither pelvis nor thigh.
    let hip_joint = words.ends_with(&["hip".to_owned(), "joint".to_owned()]);
    words.retain(|word| !DECORATIONS.contains(&word.as_str()));
    let spoken = separate_side(&mut words);
    let part = last_words(&words).find_map(|text| part_of(&text));
    let (side, part) = match glued(&words) {
        Some((side, part)) if spoken.is_none() => (Some(side), Some(part)),
        _ => (spoken, part),
    };
    let part = match part {
        Some(Part::Pelvis) if hip_joint => None,
        Some(Part::Pelvis) if side.is_some() && says_hip(&words) => Some(Part::Thigh),
        part => part,
    };
    Named { side, part }
}

fn says_hip(words: &[String]) -> bool {
    words
        .last()
        .is_some_and(|word| word.ends_with("hip") || word.ends_with("hips"))
}

/// Lower-case words of a name without its namespace; numbers are left out.
fn words(name: &str) -> Vec<String> {
    let bare = name.rsplit([':', '|']).next().unwrap_or(name);
    let letters: Vec<char> = bare.chars().collect();
    let mut words = Vec::new();
    let mut word = String::new();
    for (i, &letter) in letters.iter().enumerate() {
        let before = i.checked_sub(1).map(|i| letters[i]);
        let capital = letter.is_uppercase()
            && before.is_some_and(|b| {
                b.is_lowercase()
                    || (b.is_uppercase() && letters.get(i + 1).is_some_and(|c| c.is_lowercase()))
            });
        if !letter.is_alphabetic() || capital {
            words.extend((!word.is_empty()).then(|| std::mem::take(&mut word)));
        }
        if letter.is_alphabetic() {
            word.extend(letter.to_lowercase());
        }
    }
    words.extend((!word.is_empty()).then_some(word));
    words
}

/// Takes the word for the side out of the words.
fn separate_side(words: &mut Vec<String>) -> Option<Side> {
    let side_of = |word: &String| {
        Side::BOTH
            .into_iter()
            .find(|side| SIDES[*side as usize].contains(&word.as_str()))
    };
    let index = words.iter().position(|word| side_of(word).is_some())?;
    let side = side_of(&words[index]);
    words.remove(index);
    side
}

/// The last words joined into one, the longest first.
fn last_words(words: &[String]) -> impl Iterator<Item = String> {
    (1..=LONGEST.min(words.len()))
        .rev()
        .map(|count| words[words.len() - count..].concat())
}

fn part_of(word: &str) -> Option<Part> {
    let row = WORDS.iter().find(|(_, words)| words.contains(&word));
    row.map(|(part, _)| *part)
}

/// A side written together with the body's word: `lhumerus`, `LUArm`, `左腕`.
fn glued(words: &[String]) -> Option<(Side, Part)> {
    last_words(words).find_map(|text| {
        Side::BOTH.into_iter().find_map(|side| {
            SIDES[side as usize].iter().find_map(|word| {
                let rests = [text.strip_prefix(word), text.strip_suffix(word)];
                let part = rests.into_iter().flatten().find_map(part_of)?;
                let part = if part == Part::Pelvis {
                    Part::Thigh
                } else {
                    part
                };
                Some((side, part))
            })
        })
    })
}

/// Whose names these are, for a person to read; the first row all of whose names are there wins.
pub(crate) fn scheme(names: &[&str]) -> &'static str {
    let has = |pattern: &&str| {
        let pattern = pattern.to_ascii_lowercase();
        names.iter().any(|name| {
            let name = name.to_ascii_lowercase();
            pattern
                .strip_suffix('*')
                .map_or(name == pattern, |start| name.starts_with(start))
        })
    };
    SCHEMES
        .iter()
        .find(|(_, patterns)| patterns.iter().all(has))
        .map_or("unknown", |(scheme, _)| scheme)
}

/// Names by which a scheme is known; `*` stands for any end.
const SCHEMES: &[(&str, &[&str])] = &[
    ("Mixamo", &["mixamorig*"]),
    ("VRM", &["J_Bip_*"]),
    ("Character Creator", &["CC_Base_*"]),
    ("Source engine", &["ValveBiped*"]),
    ("3ds Max Biped", &["Bip0*"]),
    ("Rigify", &["DEF-*"]),
    ("SMPL (Maya)", &["m_avg_*"]),
    ("SMPL (Maya)", &["f_avg_*"]),
    ("MakeHuman", &["upperarm01.L", "lowerarm01.L"]),
    ("OptiTrack Motive", &["LUArm", "LFArm"]),
    ("iPi", &["LClavicle", "LShoulder", "LForearm"]),
    ("DAZ", &["lShldrBend", "lForearmBend"]),
    ("Poser", &["lShldr", "lForeArm"]),
    ("Acclaim", &["lhumerus", "lradius"]),
    ("CMU (cgspeed)", &["LHipJoint", "LowerBack", "LeftForeArm"]),
    (
        "Unreal mannequin",
        &["clavicle_l", "upperarm_l", "lowerarm_l"],
    ),
    ("Kinect", &["ElbowLeft", "WristLeft"]),
    ("Second Life", &["mElbowLeft"]),
    ("SMPL", &["L_Collar", "L_Elbow"]),
    ("SMPL", &["left_collar", "left_elbow"]),
    ("Rokoko", &["LeftForeArm", "LeftThigh"]),
    ("Xsens", &["LeftUpperArm", "LeftForeArm"]),
    ("Unity humanoid", &["LeftUpperArm", "LeftLowerArm"]),
    ("MotionBuilder", &["LeftArm", "LeftForeArm"]),
    ("Poser-friendly", &["LeftCollar", "LeftElbow"]),
    ("Blender", &["upper_arm.L", "forearm.L"]),
    ("Meta", &["b_l_arm", "b_l_forearm"]),
    ("MikuMikuDance", &["左腕"]),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_many_schemes_are_understood() {
        use Part::{
            Ankle, Collar, Elbow, Hand, Index, Knee, Leg, Pelvis, Shoulder, Thigh, Thumb, Toe,
            UpperArm, Wrist,
        };
        let cases: &[(&str, Option<Side>, Option<Part>)] = &[
            ("Hips", None, Some(Pelvis)),
            ("mixamorig:LeftForeArm", Some(Side::Left), Some(Elbow)),
            ("mixamorig_RightUpLeg", Some(Side::Right), Some(Thigh)),
            ("mixamorigLeftHand", Some(Side::Left), Some(Hand)),
            ("Bip01 L UpperArm", Some(Side::Left), Some(UpperArm)),
            ("Bip001_R_Forearm", Some(Side::Right), Some(Elbow)),
            (
                "ValveBiped.Bip01_L_Clavicle",
                Some(Side::Left),
                Some(Collar),
            ),
            ("J_Bip_L_LowerArm", Some(Side::Left), Some(Elbow)),
            ("J_Bip_C_Hips", None, Some(Pelvis)),
            ("CC_Base_R_Upperarm", Some(Side::Right), Some(UpperArm)),
            ("CC_Base_L_UpperarmTwist01", Some(Side::Left), None),
            ("DEF-forearm.L", Some(Side::Left), Some(Elbow)),
            ("DEF-upper_arm.R.001", Some(Side::Right), Some(UpperArm)),
            ("LeftArm_JNT", Some(Side::Left), Some(UpperArm)),
            ("R_Wrist_bind", Some(Side::Right), Some(Wrist)),
            ("forearm.L.001", Some(Side::Left), Some(Elbow)),
            ("upperarm_twist_01_l", Some(Side::Left), None),
            ("lowerarm_l", Some(Side::Left), Some(Elbow)),
            ("upperarm01.L", Some(Side::Left), Some(UpperArm)),
            ("LUArm", Some(Side::Left), Some(UpperArm)),
            ("RFArm", Some(Side::Right), Some(Elbow)),
            ("lhumerus", Some(Side::Left), Some(UpperArm)),
            ("rradius", Some(Side::Right), Some(Elbow)),
            ("lShldrBend", Some(Side::Left), Some(UpperArm)),
            ("rShldr", Some(Side::Right), Some(Shoulder)),
            ("LThumb", Some(Side::Left), Some(Thumb)),
            ("LeftHandThumb1", Some(Side::Left), Some(Thumb)),
            ("LeftHandIndex1", Some(Side::Left), Some(Index)),
            ("ElbowLeft", Some(Side::Left), Some(Elbow)),
            ("mShoulderLeft", Some(Side::Left), Some(Shoulder)),
            ("b_r_forearm", Some(Side::Right), Some(Elbow)),
            ("m_avg_L_Hip", Some(Side::Left), Some(Thigh)),
            ("LHipJoint", Some(Side::Left), None),
            ("LeftHip", Some(Side::Left), Some(Thigh)),
            ("lowerarm", None, Some(Elbow)),
            ("LeftLeg", Some(Side::Left), Some(Leg)),
            ("LShin", Some(Side::Left), Some(Knee)),
            ("LeftToeBase", Some(Side::Left), Some(Toe)),
            ("左腕", Some(Side::Left), Some(UpperArm)),
            ("右足首", Some(Side::Right), Some(Ankle)),
            ("Neck", None, None),
            ("", None, None),
        ];
        for (name, side, part) in cases {
            let found = parse(name);
            assert_eq!((found.side, found.part), (*side, *part), "{name}");
        }
    }

    #[test]
    fn schemes_have_names() {
        assert_eq!(scheme(&["mixamorig:Hips"]), "Mixamo");
        assert_eq!(scheme(&["Hips", "LeftArm", "LeftForeArm"]), "MotionBuilder");
        assert_eq!(scheme(&["a", "b"]), "unknown");
    }
}
