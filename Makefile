# make demo    sets up, runs the agent on a real photograph
# make test    sets up, runs every check
PYTHON ?= python3
# The checks need torch on the CPU only; pin what pip should take (an index or a file of yours works too).
TORCH ?= torch==2.13.0
# One test asks transformers' own server, which wants torchvision; all others run without, as users may.
TORCHVISION ?= torchvision==0.28.0
# Simulator assets: read as data, so their own requirements stay out.
SIM_ASSETS ?= metaworld==3.1.1 gymnasium-robotics==1.4.2 robosuite==1.5.2
BIN := .venv/bin
PIP := $(BIN)/pip install -q --disable-pip-version-check

.PHONY: demo test check system docs perf train clean

demo: .venv/.demo
	@echo 'a photograph: a4 predict examples/coffee.jpg "fill the cup"'
	@$(BIN)/a4 predict examples/coffee.jpg "fill the cup" --profile offline --out out/demo --overwrite
	@echo 'a scene of the simulator benchmark: a4 predict examples/sim/images/0001-mug.jpg "pick up the mug by its handle"'
	@$(BIN)/a4 predict examples/sim/images/0001-mug.jpg "pick up the mug by its handle" --profile offline --out out/demo --overwrite
	@echo 'to go on: source .venv/bin/activate'

test: .venv/.test system check

check:
	$(BIN)/ruff check src tests perf
	$(BIN)/ruff format --check -q src tests perf
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m pytest -rs -n 2 --dist loadfile

# The network of the offline profile: draws, trains for 160 minutes, exports; goes on after a stop.
train: .venv/.test
	$(PIP) $(TORCH) -e '.[train]'
	$(BIN)/python -m a4agent.offline.training

docs: .venv/.test
	$(BIN)/mkdocs build --strict -q

perf: .venv/.test
	$(BIN)/python perf/start.py
	$(BIN)/python perf/engine.py
	$(BIN)/python perf/metrics.py

# What some tests drive: a browser for the page and the report, a software renderer for the simulator.
# Without root they are skipped, each naming its package.
system:
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! { command -v chromium && ldconfig -p | grep -q libOSMesa; } >/dev/null; then \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium libosmesa6 >/dev/null; \
	fi

.venv/pyvenv.cfg:
	$(PYTHON) -m venv .venv

.venv/.demo: .venv/pyvenv.cfg pyproject.toml
	@echo 'setting up .venv, once: about 150 MB from the package index'
	$(PIP) -e '.[offline]'
	@touch $@

.venv/.test: .venv/pyvenv.cfg pyproject.toml
	@echo 'setting up .venv for the checks, once: some gigabytes from the package index'
	$(PIP) $(TORCH)
	$(PIP) -e '.[all,test]'
	$(PIP) --no-deps $(SIM_ASSETS)
	$(PIP) --no-deps --target .venv/torchvision $(TORCHVISION)
	@touch $@ .venv/.demo

clean:
	rm -rf .venv out site .pytest_cache .ruff_cache .hypothesis
