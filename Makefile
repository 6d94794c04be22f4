# make demo: scan the example part and say which pictures and report to open.
# make test: run every test; those of the Python package where there is Python and PyPI.
# make bench: run every bench, ratios in docs/benchmarks.md; make bench BASE=GIT-REF holds
#   that commit against this checkout.
# make verify: the long checks and those with other programs, figures in docs/verification.md;
#   VERIFY=small takes two minutes at most.
# make docs: the book of docs/ as HTML in out/book, and its links checked; needs mdBook.
# make wheel: Python package with its libraries, in out/wheel; pip installs it without a compiler.
# make release: stripped program and wheel in out/release, after checks of interface and licences.
# All except docs first install what the machine lacks.
# rustup's cargo is found even by a shell that has not read its profile.
export PATH := $(PATH):$(or $(CARGO_HOME),$(HOME)/.cargo)/bin

.PHONY: demo test bench verify docs wheel release setup

demo: setup
	cargo run --release -- scan scenes/bracket/scene.toml -o out/demo

# With all features and the C library, in one build; its own tests compile C programs.
test: setup
	cargo test -p lasertrace -p lasertrace-c --features lasertrace/service,lasertrace/race
	bindings/python/test.sh

bench: setup
	benches/run.sh $(BASE)

verify: setup
	tests/verify.sh $(VERIFY)

docs:
	python3 lab/links.py
	@command -v mdbook >/dev/null || { echo "make docs: mdbook is missing: apt-get install mdbook (Debian 13), or" \
		"cargo install mdbook" >&2; exit 1; }
	mdbook build

wheel: setup
	bindings/python/wheel.sh out/wheel

release: setup
	lab/release.sh out/release

setup:
	@sh ffi/setup.sh
