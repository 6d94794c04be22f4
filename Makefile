# make demo: scan the example part and say which pictures and report to open.
# make test: run every test.
# make bench: run every bench, figures in out/bench/index.md; benches/run.sh does more.
# All first install what the machine lacks.
# rustup's cargo is found even by a shell that has not read its profile.
export PATH := $(PATH):$(or $(CARGO_HOME),$(HOME)/.cargo)/bin

.PHONY: demo test bench setup

demo: setup
	cargo run --release -- scan scenes/bracket/scene.toml -o out/demo

test: setup
	cargo test

bench: setup
	benches/run.sh

setup:
	@sh ffi/setup.sh
