//! What a model is good for in a room, told from its catalogue entry.

use super::catalogue::Entry;

/// Where a model may stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) enum Role {
    Chair,
    OfficeChair,
    Stool,
    Armchair,
    Sofa,
    Bench,
    DiningTable,
    CoffeeTable,
    Desk,
    Bedside,
    Bed,
    Wardrobe,
    Bookcase,
    Chest,
    BaseUnit,
    WallUnit,
    Fridge,
    Hood,
    Bath,
    Basin,
    Toilet,
    Shower,
    Tv,
    WallTv,
    Computer,
    FloorLamp,
    TableLamp,
    CeilingLamp,
    WallLamp,
    FloorPlant,
    SmallPlant,
    Rug,
    Door,
    Window,
    Radiator,
    Curtain,
    WallThing,
    Person,
    Animal,
    Leisure,
    Workshop,
    KitchenThing,
    BathThing,
    DeskThing,
    Toy,
    Clothes,
    Tool,
    Ornament,
}

/// A rule: a role, the category (any if empty), words of which the name has one (any name without words), words of which it has
/// none, and the range of the height and of the longest side on the floor, metres.
struct Rule(Role, &'static str, &'static [&'static str], &'static [&'static str], [f32; 2], [f32; 2]);

const ALL: [f32; 2] = [0.0, 100.0];
const SMALL: [f32; 2] = [0.0, 0.62];
const ROOM: [f32; 2] = [0.0, 3.0];

/// Names that suit no room.
const OUTDOORS: &[&str] = &[
    "tree",
    "pool",
    "swing",
    "tent",
    "snow",
    "horse",
    "lying",
    "sitting",
    "holding",
    "elevator",
    "escalator",
    "garage",
    "railing",
    "fence",
    "container",
    "stair",
    "chimney",
    "screen door",
    "shutter",
    "grid",
    "plug",
    "socket",
    "barnum",
    "jacuzzi",
    "fountain",
    "bill ",
    "arrow",
    "parking",
    "smoke",
    "mezzanine",
    "contemporary living",
    "technical table",
    "blinds",
    "convertible",
    "surveillance",
    "double vanity",
    "opened",
    "folding chair",
];

/// The first rule that fits counts.
#[rustfmt::skip]
const RULES: &[Rule] = &[
    Rule(Role::CeilingLamp, "Lights", &["ceiling", "hanging", "pendant", "chandelier", "fluorescent light", "track"], &[], ALL, ROOM),
    Rule(Role::CeilingLamp, "Miscellaneous", &["ceiling fan"], &[], ALL, ROOM),
    Rule(Role::TableLamp, "Lights", &[], &["street", "park", "post", "porch", "outdoor", "wall", "strip", "flash"], [0.1, 0.85], [0.0, 0.6]),
    Rule(Role::FloorLamp, "Lights", &[], &["street", "park", "post", "porch", "outdoor", "wall", "strip"], [0.85, 2.2], ROOM),
    Rule(Role::WallLamp, "Lights", &["wall"], &[], ALL, SMALL),
    Rule(Role::Person, "Characters", &["male", "female", "boy", "girl", "mannequin"], &[], [1.4, 2.1], [0.0, 1.0]),
    Rule(Role::Animal, "Characters", &["cat", "dog", "rabbit", "chicken"], &[], [0.2, 0.9], [0.0, 1.0]),
    Rule(Role::Radiator, "", &["radiator"], &[], [0.3, 1.6], [0.0, 2.3]),
    Rule(Role::Curtain, "", &["curtain"], &["shower"], ALL, ROOM),
    Rule(Role::WallTv, "", &["wall flat tv"], &[], ALL, ROOM),
    Rule(Role::Tv, "Living room", &["tv"], &["stand", "remote", "cabinet"], ALL, [0.0, 1.4]),
    Rule(Role::Computer, "Office", &["imac", "ibook", "laptop"], &[], ALL, SMALL),
    Rule(Role::Computer, "", &["computer", "monitor"], &["table", "desk"], [0.2, 0.7], [0.0, 0.8]),
    Rule(Role::Rug, "", &["rug", "carpet", "bathmat", "doormat", "tatami"], &[], [0.0, 0.08], ROOM),
    Rule(Role::Toilet, "Bathroom", &["toilets", "bidet"], &[], ALL, [0.0, 1.0]),
    Rule(Role::Bath, "Bathroom", &["bath"], &["mat", "corner"], [0.4, 1.2], [1.2, 2.2]),
    Rule(Role::Shower, "Bathroom", &["shower stall"], &[], ALL, ROOM),
    Rule(Role::Basin, "Bathroom", &["washbasin", "vanity", "lavatory"], &[], ALL, [0.3, 1.3]),
    Rule(Role::WallThing, "Bathroom", &["towel", "shower head", "dispenser", "urinal", "toilet brush"], &[], ALL, [0.0, 0.8]),
    Rule(Role::Hood, "Kitchen", &["hood"], &[], [0.1, 0.8], [0.0, 1.2]),
    Rule(Role::WallUnit, "Kitchen", &["upper", "glass door cabinet"], &["corner"], ALL, [0.0, 1.3]),
    Rule(Role::Fridge, "Kitchen", &["fridge", "refrigerator", "high cabinet", "double oven"], &["chest"], [1.0, 2.3], [0.0, 1.1]),
    Rule(Role::BaseUnit, "Kitchen", &["cabinet", "sink", "stove", "machine", "oven", "washing"], &["corner", "coffee", "small oven"], [0.7, 1.25], [0.3, 1.2]),
    Rule(Role::Stool, "", &["stool", "bar chair"], &[], [0.4, 1.2], [0.0, 0.7]),
    Rule(Role::OfficeChair, "Office", &["chair", "seat"], &[], [0.7, 1.3], [0.0, 0.8]),
    Rule(Role::Armchair, "", &["armchair", "winchester armchair", "puff", "rattan armchair", "teck chair"], &[], [0.4, 1.3], [0.5, 1.6]),
    Rule(Role::Chair, "Living room", &["chair"], &["piano"], [0.5, 1.3], [0.25, 0.85]),
    Rule(Role::Chair, "Exterior", &["cafe chair"], &[], ALL, ROOM),
    Rule(Role::Sofa, "", &["sofa", "couch"], &[], [0.5, 1.2], [1.1, 2.9]),
    Rule(Role::Bench, "", &["bench", "trunck", "ottoman"], &["work", "abdominal", "concrete"], [0.3, 0.9], [0.5, 1.8]),
    Rule(Role::CoffeeTable, "", &["coffee table", "rattan table"], &[], ALL, ROOM),
    Rule(Role::CoffeeTable, "Living room", &["table"], &["tennis"], [0.3, 0.62], [0.5, 1.6]),
    Rule(Role::Desk, "", &["desk", "workbench", "office"], &["lamp", "custom", "chair"], [0.6, 1.9], [0.8, 2.1]),
    Rule(Role::Desk, "Office", &["table"], &[], [0.6, 1.1], [0.8, 2.1]),
    Rule(Role::DiningTable, "Living room", &["table"], &["tennis", "children"], [0.62, 1.05], [0.6, 2.4]),
    Rule(Role::DiningTable, "Exterior", &["cafe table"], &[], ALL, ROOM),
    Rule(Role::Bedside, "", &["bedside", "nightstand", "filing", "dustbin", "safe"], &[], [0.3, 0.75], [0.2, 0.7]),
    Rule(Role::Bed, "Bedroom", &["bed", "futon"], &["bedside", "rocking", "bunk", "sofa"], [0.15, 1.3], [1.6, 2.4]),
    Rule(Role::Bed, "Bedroom", &["bunk bed"], &[], ALL, ROOM),
    Rule(Role::Wardrobe, "Bedroom", &["wardrobe", "cupboard", "clothes rack"], &[], [1.0, 2.5], [0.5, 2.3]),
    Rule(Role::Bookcase, "", &["bookcase", "shelves", "shelf", "bookshelf"], &["upper"], [0.7, 2.3], [0.3, 2.7]),
    Rule(Role::Chest, "", &["dresser", "chest", "television cabinet", "tv stand", "dressing table", "changing table", "fireplace"], &[], [0.35, 1.7], [0.6, 1.8]),
    Rule(Role::Chest, "Living room", &["box"], &[], [0.5, 1.3], [0.8, 1.8]),
    Rule(Role::Leisure, "", &["piano", "treadmill", "indoor bike", "pool table", "football table", "flipper", "fitness tower", "table tennis", "abdominal", "screen"], &["bench", "bat", "tablet"], [0.6, 2.2], [0.5, 2.9]),
    Rule(Role::Leisure, "Bedroom", &["crib", "baby bed", "doll house", "rocking horse"], &[], ALL, ROOM),
    Rule(Role::FloorPlant, "", &["plant", "yucca", "ficus", "spathiphyllum", "bamboo", "christmas"], &["box", "boxes"], [0.5, 2.2], [0.1, 1.4]),
    Rule(Role::SmallPlant, "", &["plant", "flower", "tulip", "orchid", "cactus", "bonsai", "bamboo", "lily", "ficus", "christmas"], &[], [0.08, 0.75], [0.0, 0.75]),
    Rule(Role::WallThing, "", &["cuckoo", "dart", "air conditioning - int", "intercom", "hanger", "emergency", "number lock", "switch", "thermo"], &["clothes"], ALL, [0.0, 1.0]),
    Rule(Role::Workshop, "", &["crate", "barrel", "ladder", "pallet", "cardboard", "extinguisher", "furnace", "mower", "wheelbarrow", "bike", "bicycle", "scooter", "shopping basket", "water heater", "trash", "clothes horse", "wheelchair", "punching", "suitcase", "recycling", "hose", "cone", "stroller", "tricycle", "water cooler", "white board", "dustbin", "clothes basket", "box", "chest freezer"], &["bread", "letter", "ammo", "medicine"], [0.2, 2.1], [0.2, 2.1]),
    Rule(Role::KitchenThing, "Kitchen", &[], &["cooktop", "induction", "hood", "tools", "towel"], [0.0, 0.5], SMALL),
    Rule(Role::BathThing, "Bathroom", &[], &["mat"], [0.0, 0.5], SMALL),
    Rule(Role::Clothes, "Bedroom", &["shoes", "sneaker", "slipper", "bootie", "bag", "hat", "cap", "helmet", "clothes", "glove", "briefcase", "mocassin", "teddy"], &["hanging"], [0.02, 0.5], SMALL),
    Rule(Role::Toy, "Bedroom", &["toy", "car", "doll", "puzzle", "chess", "clock", "train", "xylo", "rubik", "teddy", "biplane", "wood"], &[], [0.01, 0.5], SMALL),
    Rule(Role::DeskThing, "Office", &[], &[], [0.005, 0.5], SMALL),
    Rule(Role::Tool, "Miscellaneous", &["drill", "grinder", "hammer", "saw", "screwdriver", "pliers", "tape", "fan", "radio", "locker", "camera", "headphone"], &["cctv"], [0.005, 0.5], [0.0, 0.65]),
    Rule(Role::Clothes, "Miscellaneous", &["backpack", "ball", "umbrella", "gift"], &[], [0.05, 0.9], SMALL),
    Rule(Role::DeskThing, "Miscellaneous", &["book", "glasses", "phone", "iphone", "keys", "newspaper", "tablet", "stereo", "speaker", "mp3"], &[], [0.004, 0.6], SMALL),
    Rule(Role::Ornament, "Miscellaneous", &["vase", "frame", "radio", "gift"], &["chambord"], [0.08, 0.9], SMALL),
    Rule(Role::Ornament, "Living room", &["aquarium", "deer", "joystick", "playstation", "dvd", "phone", "remote", "projector", "keyboard"], &[], [0.02, 0.6], [0.0, 0.85]),
];

/// What the entry's model is good for; none for what belongs outdoors or fits no room.
pub(super) fn role(entry: &Entry) -> Option<Role> {
    let name = entry.name.to_lowercase();
    let [width, height, depth] = entry.size;
    if entry.opening {
        let fits = width < 1.95 && height < 2.4;
        return match () {
            () if !fits || name.contains("garage") || name.contains("elevator") || name.contains("turn") => {
                None
            }
            () if name.contains("window") => Some(Role::Window),
            () if name.contains("door") => Some(Role::Door),
            () => None,
        };
    }
    if OUTDOORS.iter().any(|word| name.contains(word)) && !name.contains("christmas") {
        return None;
    }
    let long = width.max(depth);
    let within = |v: f32, range: [f32; 2]| (range[0]..=range[1]).contains(&v);
    let fits = |rule: &&Rule| {
        (rule.1.is_empty() || rule.1 == entry.category)
            && (rule.2.is_empty() || rule.2.iter().any(|w| name.contains(w)))
            && !rule.3.iter().any(|w| name.contains(w))
            && within(height, rule.4)
            && within(long, rule.5)
    };
    RULES.iter().find(fits).map(|rule| rule.0)
}

#[cfg(test)]
mod tests {
    use super::super::model::tests::entry;
    use super::*;

    #[test]
    fn names_categories_and_sizes_tell_the_role() {
        for (name, category, size, expected) in [
            ("Chair", "Living room", [0.45, 0.9, 0.5], Some(Role::Chair)),
            ("Children chair", "Living room", [0.28, 0.2, 0.28], None),
            ("Chair", "Office", [0.6, 1.0, 0.6], Some(Role::OfficeChair)),
            ("Corner sofa", "Living room", [2.4, 0.8, 1.5], Some(Role::Sofa)),
            ("Glass table", "Living room", [1.6, 0.75, 0.9], Some(Role::DiningTable)),
            ("Coffee table", "Living room", [1.2, 0.45, 0.7], Some(Role::CoffeeTable)),
            ("Bedside table", "Bedroom", [0.5, 0.45, 0.4], Some(Role::Bedside)),
            ("Iron bed", "Bedroom", [1.3, 1.1, 2.1], Some(Role::Bed)),
            ("Desk lamp", "Lights", [0.2, 0.4, 0.4], Some(Role::TableLamp)),
            ("Street lamp", "Lights", [0.4, 2.5, 0.4], None),
            ("TV stand", "Living room", [1.3, 0.5, 0.46], Some(Role::Chest)),
            ("TV 16:9", "Living room", [0.6, 0.5, 0.3], Some(Role::Tv)),
            ("Upper cabinet", "Kitchen", [0.6, 0.7, 0.4], Some(Role::WallUnit)),
            ("Lower cabinet", "Kitchen", [0.6, 0.88, 0.6], Some(Role::BaseUnit)),
            ("Coffee machine", "Kitchen", [0.58, 0.36, 0.4], Some(Role::KitchenThing)),
            ("Toilet brush", "Bathroom", [0.1, 0.4, 0.13], Some(Role::WallThing)),
            ("Male", "Characters", [0.6, 1.85, 0.4], Some(Role::Person)),
            ("Sitting male", "Characters", [0.6, 1.4, 0.9], None),
            ("Pine tree", "Exterior", [3.0, 8.0, 3.0], None),
            ("Swimming pool", "Exterior", [17.0, 4.0, 10.0], None),
            ("Truck", "Vehicles", [2.8, 4.0, 21.0], None),
        ] {
            assert_eq!(role(&entry("a", name, category, size)), expected, "{name}");
        }
        let mut door = entry("a", "Exterior door", "Doors and windows", [1.0, 2.1, 0.2]);
        door.opening = true;
        assert_eq!(role(&door), Some(Role::Door));
        assert_eq!(role(&Entry { name: "Garage door".into(), ..door.clone() }), None);
        assert_eq!(role(&Entry { name: "Double window".into(), ..door.clone() }), Some(Role::Window));
        assert_eq!(role(&Entry { size: [4.0, 2.1, 0.2], ..door }), None);
    }
}
