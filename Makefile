# FogROS2-PLR. Every target sets up what it needs, from a bare checkout on; `make` lists them.

SHELL := /bin/bash
.DEFAULT_GOAL := help

PY := .venv/bin/python

# The ROS of the virtual environment must not mix with one that this shell has sourced, nor with the libraries of a
# Python process of another environment that runs us.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH RMW_IMPLEMENTATION
unexport ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Nothing that we start announces itself to the network.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

.PHONY: help setup demo test quick fuzz lint format protos pages docs interfaces lock bench bench-quick bench-dataplane bench-churn bench-insiders bench-control bench-fleet-day bench-drives bench-matcher clean distclean

help: ## show this list
	@echo 'usage: make TARGET'
	@echo
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):[^#]*## (.*)/\1\t\2/' | while IFS=$$'\t' read -r target what; do printf '  %-15s %s\n' "$$target" "$$what"; done
	@echo
	@echo 'options:'
	@echo "  make test PYTEST_ARGS='tests/unit -k histogram'"
	@echo "  make demo DEMO_ARGS='--help'"
	@echo "  make bench-dataplane BENCH_ARGS='--help'"

setup: ## install Debian packages, .venv, locked dependencies, example interfaces (the other targets run it)
	@deploy/dev/setup.sh

demo: setup ## show a robot that keeps its deadline while a link, a server and the control plane die (about two minutes)
	@$(PY) -m lab.demo $(DEMO_ARGS)

test: setup ## run all tests
	@deploy/dev/test.sh $(PYTEST_ARGS)

quick: setup ## check what changed since COMMIT=main: lint, its unit tests, a slice of the simulations (a minute)
	@deploy/dev/quick.sh $(COMMIT)

fuzz: setup ## run each fuzzing test with a million junk datagrams (10 minutes, as root)
	@$(PY) -m pytest tests/fuzz tests/attacks/test_fuzz.py --fuzz-datagrams 1000000 $(PYTEST_ARGS)

lint: setup ## run ruff, mypy and the import rules, and compare the generated stubs and pages
	@deploy/dev/lint.sh

format: setup ## rewrite the sources the way lint wants them
	@$(PY) -m ruff check --fix --exit-zero --quiet .
	@$(PY) -m ruff format --quiet .

protos: setup ## generate the gRPC stubs from protos/plr/v1/*.proto
	@deploy/dev/protos.sh

pages: setup ## write the keys and the figures of the code into docs/use/configuration.md and docs/operate/limits.md
	@$(PY) -m deploy.dev.pages

docs: setup ## build the site of README.md and docs/ into build/site: open build/site/index.html
	@deploy/dev/docs.sh

interfaces: setup ## build examples/plr_demo_interfaces into .venv

lock: setup ## lock the dependencies of pyproject.toml again (LOCK_ARGS=--upgrade for newer versions)
	@deploy/dev/lock.sh $(LOCK_ARGS)

bench: setup ## run every measurement, one after the other; reports go to bench/results (hours, as root)
	@$(PY) -m bench $(BENCH_ARGS)

bench-quick: setup ## run 15 s of a drive with every contender: direct ROS 2, MPTCP, zenoh, ours (5 minutes at most, as root)
	@$(PY) -m bench evaluate --quick $(BENCH_ARGS)

bench-dataplane: setup ## compare the data plane with its targets, and with TCP, MPTCP, QUIC and zenoh (20 minutes, as root)
	@$(PY) -m bench dataplane $(BENCH_ARGS)

bench-churn: setup ## let interfaces, servers and the control plane come and go for ten minutes under load: nothing is lost, nothing grows
	@$(PY) -m bench churn $(BENCH_ARGS)

bench-insiders: setup ## let two members attack the fleet in every way at once for ten minutes: nothing is lost (as root)
	@$(PY) -m bench insiders $(BENCH_ARGS)

bench-control: setup ## measure the control plane with 500 to 4,000 sidecars: a restart, steady load, a dead server (20 minutes)
	@$(PY) -m bench control $(BENCH_ARGS)

bench-fleet-day: setup ## simulate 24 hours of a fleet of 1,000 that joins, leaves, roams and loses servers: nothing drifts, nothing grows
	@$(PY) -m bench fleet-day $(BENCH_ARGS)

bench-drives: setup ## compare the real cores with oracles on recorded drives, in simulated time (half an hour)
	@$(PY) -m bench drives $(BENCH_ARGS)

bench-matcher: setup ## compare the matcher's predictions with recorded networks, and measure its speed and reaction (half an hour)
	@$(PY) -m bench matcher $(BENCH_ARGS)

clean: ## remove caches and build output
	@rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis *.egg-info
	@find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +

distclean: clean ## clean, and remove .venv
	@rm -rf .venv
