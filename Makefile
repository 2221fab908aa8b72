# Every target makes its own .venv when there is none and installs what it needs.
PYTHON ?= python3
PYTHON310 ?= python3.10
PYTHON312 ?= python3.12
OUT ?= out
SAMPLES := vln-babyai vla-metaworld vla-flow
SET :=
TORCH := torch==2.13.0
SYSTEM_PACKAGES := libosmesa6 libegl1 libgl1

BASE ?=
ARM64 ?=
LADDER ?=
SETS ?=
FOREIGN ?= --guides

# SET=avx2 and others: `make test`, `make peers` and `make demo` in an environment of their own, confined to that set.
ifeq ($(SET),)
VENV := .venv
MADE := $(OUT)
confine =
else
MADE := $(OUT)/confined/$(SET)
VENV := $(MADE)/venv
CONFINING := capstone pyelftools
ABLE := able
confine = $(1)/bin/python tests/validation/processors/confine.py $(1) $(SET)
export VLATOOL_CACHE := $(abspath $(MADE))/cache
export VLATOOL_CALIBRATIONS := $(abspath $(MADE))/calibrations
ifneq ($(filter-out test peers demo confined,$(or $(MAKECMDGOALS),help)),)
$(error SET is for 'make test', 'make peers' and 'make demo')
endif
endif
BIN := $(VENV)/bin

# venv INTERPRETER,FOLDER: makes an environment unless it is there; one without pip, such as one that was interrupted, is completed.
venv = @$(2)/bin/python -m pip --version > /dev/null 2>&1 || $(1) -m venv $(2)

RUNTIME_WHEEL := $(OUT)/wheels/vlatool_runtime-*.whl

.PHONY: able confined sets wheels foreign lerobot gate peers python310 arm64 ladder help install demo test soak coverage check robot docs format clean metaworld

help:  ## list the targets
	@grep -hE '^[a-z0-9]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

able:
	@$(PYTHON) tests/validation/processors/confine.py --able $(SET)

$(BIN)/vlatool: pyproject.toml | $(ABLE)
	$(call venv,$(PYTHON),$(VENV))
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(TORCH) -e '.[ort,build,sim,text]' $(CONFINING)
	@touch $@

install: $(BIN)/vlatool  ## install vlatool with what the demo needs

$(VENV)/.dev: $(BIN)/vlatool
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(TORCH) -e '.[ort,build,sim,text,dev]'
	@touch $@

demo: $(BIN)/vlatool  ## optimise the sample policy vln-babyai for a Raspberry Pi 5, with a report (SET=avx2: on an older processor)
	$(call confine,$(VENV))
	$(BIN)/vlatool optimize sample_models/vln-babyai --profile raspberry-pi-5 --max-drop 1% --episodes 1500 -o $(MADE)/vln-babyai --force

metaworld: $(BIN)/vlatool  ## install what the sample policies vla-metaworld and vla-flow need
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(TORCH) -e '.[ort,build,metaworld]'
	@ldconfig -p | grep -q libEGL.so.1 || apt-get install -y -qq $(SYSTEM_PACKAGES) || \
	  echo "headless rendering needs the system packages $(SYSTEM_PACKAGES)"

test: $(VENV)/.dev  ## run the tests (SET=avx2: as on a processor with AVX2 alone; docs/concepts/processors.md)
	$(call confine,$(VENV))
	$(BIN)/python -m pytest -n auto --dist worksteal

soak: $(VENV)/.dev  ## run the tests in their full form: every draw, kill and case of those that have many
	$(BIN)/python -m pytest -n auto --dist worksteal --full

coverage: $(VENV)/.dev  ## run the tests with coverage, in about twice the time; below 90 % fails
	$(BIN)/python -m pytest --cov --cov-report=term:skip-covered -n auto --dist worksteal

check: $(VENV)/.dev  ## lint, format, types, layers, names, docs that match the code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/structure/words.py
	$(BIN)/python tests/structure/count.py --check
	$(BIN)/python tests/structure/rooms.py --check
	$(BIN)/python docs/generate.py --check
	$(BIN)/python docs/check.py

wheels: $(BIN)/vlatool  ## build both distributions: vlatool, and vlatool-runtime for robots
	rm -rf $(OUT)/wheels
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w $(OUT)/wheels . ./robot

robot: wheels  ## run an int8 bundle as a robot would: Python 3.10, vlatool-runtime, onnxruntime 1.23, nothing else
	$(BIN)/vlatool quantize sample_models/vln-babyai -o $(OUT)/robot/bundle --force
	$(call venv,$(PYTHON310),$(OUT)/robot/venv)
	$(OUT)/robot/venv/bin/python -m pip install --quiet --disable-pip-version-check onnxruntime==1.23.2 $(RUNTIME_WHEEL)
	$(OUT)/robot/venv/bin/python -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps $(RUNTIME_WHEEL)
	$(OUT)/robot/venv/bin/python tests/robot/controller.py $(OUT)/robot/bundle --max-mb 130
	$(OUT)/robot/venv/bin/python -W error tests/robot/alone.py $(OUT)/robot/bundle

python310: $(BIN)/vlatool  ## run the build side's commands on an exported bundle under Python 3.10, without torch
	for sample in $(SAMPLES); do $(BIN)/vlatool export sample_models/$$sample -o $(OUT)/python310/$$sample --force || exit 1; done
	$(call venv,$(PYTHON310),$(OUT)/python310/venv)
	$(OUT)/python310/venv/bin/python -m pip install --quiet --disable-pip-version-check -e '.[ort]' onnx onnxscript onnx-ir safetensors
	$(OUT)/python310/venv/bin/python tests/robot/build_side.py $(SAMPLES:%=$(OUT)/python310/%) -o $(OUT)/python310/made

arm64: $(BIN)/vlatool  ## run both samples' bundles on emulated 64-bit ARM and compare with this host (ARM64="--cores cortex-a76": less of it)
	$(BIN)/python tests/validation/processors/arm64.py -o $(OUT)/processors $(ARM64)

ladder: $(VENV)/.dev  ## hold every layout on every engine and instruction set of this host against what its graphs say
	$(BIN)/python tests/validation/processors/ladder.py -o $(OUT)/processors $(LADDER)

confined: $(VENV)/.dev
	$(call confine,$(VENV))

sets: $(VENV)/.dev  ## make bundles under every instruction set that this host can be confined to and load them under every other
	for set in $$($(BIN)/python tests/validation/processors/sets_table.py --names); do $(MAKE) confined SET=$$set || exit 2; done
	$(BIN)/python tests/validation/processors/sets_table.py -o $(OUT)/confined $(SETS)

gate: $(BIN)/vlatool  ## hold the sample policies against those that the commit before makes (BASE=COMMIT names another)
	$(BIN)/python tests/validation/own_gate/gate_samples.py --base "$(BASE)" -o $(OUT)/gate

peers: $(ABLE)  ## measure other tools and our bundles on six workloads, interleaved (about an hour; SET=avx2: on an older processor)
	$(call venv,$(PYTHON),$(MADE)/peers/venv)
	$(MADE)/peers/venv/bin/python -m pip install --quiet --disable-pip-version-check $(TORCH) -r tests/validation/peers/requirements.txt -e '.[ort,build]' $(CONFINING)
	$(call confine,$(MADE)/peers/venv)
	PYTHONPATH=. $(MADE)/peers/venv/bin/python tests/validation/peers/table.py

$(OUT)/foreign/common/.made: tests/validation/foreign/common.txt pyproject.toml
	$(call venv,$(PYTHON),$(OUT)/foreign/common)
	$(OUT)/foreign/common/bin/python -m pip install --quiet --disable-pip-version-check -r tests/validation/foreign/common.txt -e '.[ort,openvino,build,text]'
	@touch $@

$(OUT)/foreign/lerobot/.made: tests/validation/foreign/lerobot.txt pyproject.toml
	$(call venv,$(PYTHON),$(OUT)/foreign/lerobot)
	$(OUT)/foreign/lerobot/bin/python -m pip install --quiet --disable-pip-version-check -r tests/validation/foreign/lerobot.txt -e '.[ort,openvino,build,text]'
	@touch $@

$(OUT)/foreign/lerobot06/.made:
	$(call venv,$(PYTHON312),$(OUT)/foreign/lerobot06)
	$(OUT)/foreign/lerobot06/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[dataset,diffusion,smolvla]==0.6.1'
	@touch $@

lerobot: $(VENV)/.dev $(OUT)/foreign/lerobot06/.made  ## checkpoints and datasets of LeRobot 0.6, which is installed for Python 3.12 (7 GB; half an hour)
	$(BIN)/python tests/validation/foreign/lerobot_datasets.py --python $(OUT)/foreign/lerobot06/bin/python -o $(OUT)/foreign/datasets
	$(BIN)/python tests/validation/foreign/lerobot_checkpoints.py --python $(OUT)/foreign/lerobot06/bin/python --small --steps 48
	$(BIN)/python tests/validation/foreign/lerobot_optimize.py --python $(OUT)/foreign/lerobot06/bin/python -o $(OUT)/foreign/lerobot-optimize

foreign: lerobot $(OUT)/foreign/common/.made $(OUT)/foreign/lerobot/.made  ## seven policies of others through every command, and the guides as written (hours, 15 GB; FOREIGN="--only ppo_mlp")
	$(PYTHON) tests/validation/foreign/table.py --common $(OUT)/foreign/common --lerobot $(OUT)/foreign/lerobot -o $(OUT)/foreign/made $(FOREIGN)

docs: $(VENV)/.dev  ## write docs/reference, the picture of the rooms and the counts from the code
	$(BIN)/python docs/generate.py
	$(BIN)/python tests/structure/rooms.py
	$(BIN)/python tests/structure/count.py --write

format: $(VENV)/.dev  ## format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:  ## remove what the targets made
	rm -rf $(VENV) $(OUT) .pytest_cache .mypy_cache .ruff_cache .coverage*
