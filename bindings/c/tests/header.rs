//! The header is what cbindgen makes of the source, and its version that of the crate.

use std::path::Path;

/// To renew it: `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test header`.
#[test]
fn the_header_is_that_of_the_source() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap();
    let builder = cbindgen::Builder::new().with_config(config);
    let sources = ["lib", "status", "cast", "simulate"];
    let builder = sources.iter().fold(builder, |builder, file| {
        builder.with_src(root.join(format!("src/{file}.rs")))
    });
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let file = root.join("include/lasertrace.h");
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        std::fs::write(&file, &made).unwrap();
    }
    let committed = std::fs::read(&file).unwrap_or_default();
    assert!(
        committed == made,
        "include/lasertrace.h is not that of the source: run \
         `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test header`"
    );
    let text = String::from_utf8(made).unwrap();
    let parts = env!("CARGO_PKG_VERSION").split('.');
    for (part, value) in ["MAJOR", "MINOR", "PATCH"].iter().zip(parts) {
        let line = format!("#define LASERTRACE_VERSION_{part} {value}\n");
        assert!(text.contains(&line), "{line}");
    }
}
