use proptest::prelude::*;

use super::*;

/// A table as a text: name, tag, class, unit, comment, group and line of each entry.
fn shown(table: &TagTable) -> Vec<String> {
    let text = |text: Option<&str>| text.unwrap_or("-").to_owned();
    let show = |entry: &TagEntry| {
        let TagEntry { name, tag, line, .. } = entry;
        let texts = [entry.class(), entry.unit(), entry.comment(), entry.group()].map(text).join("|");
        format!("{line} {name} {tag} {texts}")
    };
    table.iter().map(show).collect()
}

const EXPECTED: [&str; 3] = [
    "2 level R100:f32 fast|m|level of the tank, \"above\" the valve|tank",
    "3 temperature R5:i16*0.1-40 slow|°C|-|tank",
    "4 alarm M7 -|-|-|-",
];

#[test]
fn tables_of_spreadsheets_are_read_in_all_their_forms() {
    let plain = "name,at,class,unit,comment,group\n\
                 level,R100:f32,fast,m,\"level of the tank, \"\"above\"\" the valve\",tank\n\
                 temperature,R5:i16*0.1-40,slow,°C,,tank\n\
                 alarm,M7,,,,\n";
    let semicolons = "name;at;class;unit;comment;group\n\
                      level;R100:f32;fast;m;\"level of the tank, \"\"above\"\" the valve\";tank\n\
                      temperature;R5:i16*0.1-40;slow;°C;;tank\n\
                      alarm;M7;;;;\n";
    let other_order = "Group,AT, Name ,comment,,unit,Class,#checked by\n\
                       tank,r00100:FLOAT, level ,\"level of the tank, \"\"above\"\" the valve\",x,m,fast,Ann\n\
                       tank,R5:short*0.1-40,temperature,,,°C,slow,Bob,\n\
                       ,M7,alarm\n";
    let bom_and_crlf = format!("\u{feff}{}", semicolons.replace('\n', "\r\n"));
    let no_last_line_feed = plain.trim_end();
    for text in [plain, semicolons, &plain.replace('\n', "\r\n"), &bom_and_crlf, no_last_line_feed, other_order] {
        assert_eq!(shown(&TagTable::from_csv(text).unwrap()), EXPECTED, "{text:?}");
    }
    let tabs = "name\tat\nlevel\tR100:f32\n";
    assert_eq!(shown(&TagTable::from_csv(tabs).unwrap()), ["2 level R100:f32 -|-|-|-"]);
    let marked = "sep=;\r\n# tags of the mixer, made by hand\r\n\r\nname;at;comment\r\n\
                  ;;\r\na;R1;\"two\r\nlines\"\r\n#b;R2;\r\nc;R3;x\r\n";
    assert_eq!(
        shown(&TagTable::from_csv(marked).unwrap()),
        ["6 a R1 -|-|two\r\nlines|-", "9 c R3 -|-|x|-"],
        "lines are those of the file"
    );
}

#[test]
fn tables_in_toml_are_read_in_the_order_of_the_file() {
    let text = "# tags of the mixer\n\
                level = { at = \"R100:f32\", class = \"fast\", unit = \"m\", group = \"tank\", \
                comment = 'level of the tank, \"above\" the valve' }\n\
                temperature = { at = \"R5:i16*0.1-40\", class = \"slow\", unit = \"°C\", group = \"tank\" }\n\
                alarm = \"M7\"\n\
                [a-table]\n\
                at = \"R0-R9\"\n";
    let expected = ["2 level", "3 temperature", "4 alarm", "5 a-table"];
    let table = TagTable::from_toml(text).unwrap();
    for (entry, expected) in shown(&table).iter().zip(expected) {
        assert!(entry.starts_with(expected), "{entry}");
    }
    assert_eq!(shown(&table)[..3], EXPECTED.map(|line| line.to_owned()));
    assert!(TagTable::from_toml("").unwrap().is_empty());
}

fn csv_faults(text: &str) -> Vec<String> {
    TagTable::from_csv(text).unwrap_err().iter().map(ToString::to_string).collect()
}

#[test]
fn all_faults_of_a_table_are_reported_with_line_and_column() {
    let text = "name,at,class\n\
                level,R100:f33,fast\n\
                a b,M7,fast\n\
                R5,R5,\n\
                ,M8,\n\
                alarm,,\n\
                fine,R1,too fast\n\
                good,R2,\n\
                good,R3,\n\
                long,R4,x,y\n";
    let faults = csv_faults(text);
    assert!(faults[0].starts_with("line 2, at: `R100:f33` is not a tag: the type is unknown (known: "), "{faults:?}");
    assert_eq!(
        faults[1..],
        [
            "line 3, name: `a b` is not a name: 1 to 64 of the characters A-Z a-z 0-9 _ - are",
            "line 4, name: `R5` is not a name: it is a tag itself",
            "line 5, name: it is missing",
            "line 6, at: it is missing",
            "line 7, class: `too fast` is not a name: 1 to 64 of the characters A-Z a-z 0-9 _ - are",
            "line 9, name: the name `good` stands in line 8 already",
            "line 10: the line has more cells than there are titles",
        ]
    );
    for (text, faults) in [
        ("", "line 1: the first line has the titles of the columns, at least name and at"),
        ("\u{feff}\r\n", "line 1: the first line has the titles of the columns, at least name and at"),
        (
            "tag,at\nx,R5\n",
            "line 1: `tag` is unknown (known: name at class unit comment group)\nline 1, name: it is missing",
        ),
        ("name,at,at\nx,R5,R6\n", "line 1, at: two columns have this title"),
        (
            "level,R5\n",
            "line 1: `level` is unknown (known: name at class unit comment group)\n\
                        line 1: `R5` is unknown (known: name at class unit comment group)\n\
                        line 1, name: it is missing\nline 1, at: it is missing",
        ),
    ] {
        assert_eq!(TagTable::from_csv(text).unwrap_err().to_string(), faults, "{text:?}");
    }
    let many: String = (0..30).map(|n| format!("n{n},Q{n}\n")).collect();
    let shown = TagTable::from_csv(&format!("name,at\n{many}")).unwrap_err().to_string();
    assert_eq!((shown.lines().count(), shown.lines().last()), (21, Some("and 10 more")));
}

/// A quote that is not closed took the lines behind it for a part of its cell, without a word.
#[test]
fn broken_quotes_lose_no_line() {
    let text = "name,at,comment\na,R1,\"5 inch\nb,Q2,x\nc,R3,y\n";
    let faults = csv_faults(text);
    assert_eq!(
        faults[0],
        "line 2: a double quote opens a cell, and none closes it; a quote in such a cell is written twice"
    );
    assert!(faults[1].starts_with("line 3, at: `Q2` is not a tag"), "{faults:?}");
    assert_eq!(faults.len(), 2);
    let faults = csv_faults("name,at\n\"a\"b,R1\nc,Q1\n");
    assert!(faults[0].starts_with("line 2: text follows a double quote"), "{faults:?}");
    assert!(faults[1].starts_with("line 3, at: "), "{faults:?}");
    assert_eq!(csv_faults("name,at\n\"#a\",R1\n").len(), 1, "a cell in quotes is no comment");

    let comments = "# a,\"b\nname,at,comment\na,R1,x\n#old,R9,\"5 inch\nb, R2 , \"x, y\" \nc,R3,5 inch\" wide\n";
    assert_eq!(
        shown(&TagTable::from_csv(comments).unwrap()),
        ["3 a R1 -|-|x|-", "5 b R2 -|-|x, y|-", "6 c R3 -|-|5 inch\" wide|-"]
    );
}

#[test]
fn separators_are_found_in_all_their_forms() {
    for text in [
        "sep=\t\r\nname\tat\r\nx\tR5\r\n",
        "\"sep=;\"\nname;at\nx;R5\n",
        "name,at,\"#x;y;z;w\"\nx,R5,\n",
        "name\tat\rx\tR5\r",
    ] {
        let table = TagTable::from_csv(text).unwrap();
        assert_eq!((table.len(), table.tag("x")), (1, Ok(crate::tag!("R5"))), "{text:?}");
    }
    assert_eq!(csv_faults("name,at\rx,R5\ry,Q5\r").len(), 1);
    assert!(csv_faults("name,at\rx,R5\ry,Q5\r")[0].starts_with("line 3, "));
}

/// 4000 tags in TOML took two minutes: the lines were counted from the beginning for each value.
#[test]
fn large_tables_take_linear_time() {
    let toml: String = (0..20_000).map(|n| format!("n{n} = {{ at = \"R{n}\", class = \"fast\" }}\n")).collect();
    let table = TagTable::from_toml(&toml).unwrap();
    assert_eq!((table.len(), table.iter().last().map(TagEntry::line)), (20_000, Some(20_000)));
}

#[test]
fn faults_of_toml_have_their_line() {
    for (text, fault) in [
        ("a = 1\n", "line 1, a: a text or a table is expected, and this is a number"),
        ("\na = { at = 5 }\n", "line 2, at: a text is expected, and this is a number"),
        ("a = { at = \"R5\", clas = \"x\" }\n", "line 1, a: `clas` is unknown (known: at class unit comment group)"),
        ("a = { at = \"R5\", name = \"b\" }\n", "line 1, a: `name` is unknown (known: at class unit comment group)"),
        ("[a]\nclass = \"x\"\n", "line 1, at: it is missing"),
        ("[a]\nclass = \"x\"\nat = \"Q5\"\n", "line 3, at: `Q5` is not a tag: no element"),
        ("\"\" = \"R5\"\n", "line 1: `` is not a name"),
        ("[tank.level]\nat = \"R5\"\n", "line 1, tank: `level` is a table within a tag, and tags have none"),
        ("M5 = \"R5\"\n", "line 1, name: `M5` is not a name: it is a tag itself"),
        ("a = \"R5\"\n\na = \"R6\"\n", "line 3: "),
        ("a = \n", "line 1: "),
    ] {
        let error = TagTable::from_toml(text).unwrap_err().to_string();
        assert!(error.starts_with(fault), "{text:?}: {error}");
    }
}

#[test]
fn names_and_tags_are_found() {
    let table = TagTable::from_csv("name,at,class\nlevel,R100:f32,fast\nLever,M7,\nlow,M8,fast\n").unwrap();
    assert_eq!(table.tag("level").unwrap(), crate::tag!("R100:f32"));
    assert_eq!(table.tag("R5:i16").unwrap(), crate::tag!("R5:i16"));
    let error = table.tag("LEVEL").unwrap_err();
    assert_eq!(error.similar_names().collect::<Vec<_>>(), ["level", "Lever"]);
    let text = error.to_string();
    assert!(text.starts_with("`LEVEL` is not a tag: no element has these letters"), "{text}");
    assert!(text.ends_with("; nor is it a name of the table (similar names: level, Lever)"), "{text}");
    assert!(table.tag("Q5").unwrap_err().to_string().ends_with("; nor is it a name of the table"));
    let classes: Vec<_> = table.by_class().into_iter().map(|(class, entries)| (class, entries.len())).collect();
    assert_eq!(classes, [(Some("fast"), 2), (None, 1)]);
    let polled = table.get("low").unwrap().poll_tag();
    assert_eq!((polled.name(), polled.tag()), ("low", crate::tag!("M8")));
    assert_eq!(table.tags().count(), table.len());
}

#[test]
fn tags_with_common_elements_are_found() {
    let table = "name,at\n\
                 bits,R7.0-R7.3\n\
                 word,WM16\n\
                 relay,M20\n\
                 far,R0-R99\n\
                 near,R10-R19\n\
                 double,DR98\n\
                 next,R100\n\
                 same,R100\n\
                 other,D100\n\
                 bit,R7.5\n\
                 more,R7.3-R7.4\n\
                 double-bit,DR6.19\n\
                 again,R7.5\n";
    let table = TagTable::from_csv(table).unwrap();
    let found: Vec<String> = table.overlaps().iter().map(ToString::to_string).collect();
    assert_eq!(
        found,
        [
            "line 4, relay (M20) has elements of word (WM16) in line 3",
            "line 6, near (R10-R19) has elements of far (R0-R99) in line 5",
            "line 7, double (DR98) has elements of far (R0-R99) in line 5",
            "line 9, same (R100) is the same tag as next (R100) in line 8",
            "line 12, more (R7.3-R7.4) has elements of bits (R7.0-R7.3) in line 2",
            "line 13, double-bit (DR6.19) has elements of bits (R7.0-R7.3) in line 2",
            "line 14, again (R7.5) is the same tag as bit (R7.5) in line 11",
        ]
    );
}

#[test]
fn files_are_loaded_by_their_name() {
    let folder = std::env::temp_dir().join(format!("fatek-table-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let load = |name: &str, content: &[u8]| {
        let path = folder.join(name);
        std::fs::write(&path, content).unwrap();
        TagTable::load(&path)
    };
    assert_eq!(load("a.csv", b"name,at\nx,R5\n").unwrap().len(), 1);
    assert_eq!(load("a.TOML", b"x = \"R5\"\n").unwrap().len(), 1);
    let error = load("b.csv", b"name,at\nx,R5\ny,R6 \xB0C\n").unwrap_err().to_string();
    assert!(error.ends_with("b.csv: line 3: the text is not UTF-8; save it as CSV UTF-8"), "{error}");
    let error = load("c.csv", b"name,at\nx,Q5\n").unwrap_err().to_string();
    assert!(error.contains("c.csv: line 2, at: `Q5` is not a tag"), "{error}");
    let missing = TagTable::load(folder.join("none.csv")).unwrap_err();
    assert!(matches!(missing, TableFileError::File(_)), "{missing}");
    std::fs::remove_dir_all(&folder).unwrap();
}

/// The tags of two tables that have common elements, by comparing all pairs.
fn share_elements(a: &Tag, b: &Tag) -> bool {
    let ((area, begin, end), (other_area, other_begin, other_end)) = (a.memory(), b.memory());
    area == other_area && begin <= other_end && other_begin <= end
}

proptest! {
    #[test]
    fn no_text_panics(
        text in prop_oneof!["\\PC{0,40}", "(name|at|class|,|;|\\n|\\r\\n|\"|[a-z]{1,3}|R[0-9]{1,3}|#| |\t){0,40}"]
    ) {
        let _ = TagTable::from_csv(&text).map(|table| table.overlaps().len());
        let _ = TagTable::from_toml(&text);
    }

    #[test]
    fn a_table_overlaps_if_and_only_if_two_tags_share_elements(
        tags in prop::collection::vec(("(R|DR|M|WM)", 0..12_u16, 1..6_usize), 0..12)
    ) {
        let tags: Vec<Tag> = tags.into_iter().filter_map(|(symbol, address, count)| {
            let first = format!("{symbol}{}", if symbol == "WM" { address / 8 * 8 } else { address }).parse().ok()?;
            let first: crate::Element = first;
            Tag::new(first, crate::tag::TagType::default_for(first.width()), count).ok()
        }).collect();
        let rows: String = tags.iter().enumerate().map(|(n, tag)| format!("n{n},{tag}\n")).collect();
        let table = TagTable::from_csv(&format!("name,at\n{rows}")).unwrap();
        let shared: Vec<usize> = (0..tags.len())
            .filter(|&n| tags.iter().enumerate().any(|(m, tag)| m != n && share_elements(tag, &tags[n])))
            .collect();
        let overlaps = table.overlaps();
        let mut named: Vec<usize> = overlaps.iter().flat_map(|overlap| [overlap.first, overlap.second])
            .map(|entry| entry.line() - 2).collect();
        named.sort_unstable();
        named.dedup();
        prop_assert_eq!(named, shared);
        prop_assert!(overlaps.iter().all(|overlap| share_elements(&overlap.first.tag(), &overlap.second.tag())));
    }
}
