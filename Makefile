# make demo   a scene made, trained, rendered and scored
# make test   lint, format check, C++ tests, pytest without the tests that are marked slow
# make check  all of that, and the slow tests
# make test-aarch64, test-windows, test-macos   the C++ tests, built for another platform and run under an emulator
# make test-browser   the tests that need Chromium, which is installed first where Debian's package manager may be used
# make test-foreign   the tests by programs of npm that read our exports; they skip without npm
# make format rewrites what the format check would complain about
# make wheels a wheel for every torch from 2.10 and every Python, one with CUDA kernels where nvcc is found, and the
#             source distribution: build/wheels
# make gate   three trainings against the stored baseline: quality and, beside an older build, time; takes minutes
# make docs   the site, build/site/index.html; a dead link or a page outside of the navigation fails
# All set up .venv first: pinned requirements and the three extensions, again only when their sources have changed.
# The site needs neither and has an environment of its own, .venv-docs.
# Variables: PYTHON (3.10 or newer); CXX, GS_CUDA, CUDA_HOME as in submodules/common/build_extension.py (after a change
# of these `rm .venv/.built-*`).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DOCS_VENV := .venv-docs
CHECK_PYTHON := import sys; sys.exit(sys.version_info < (3, 10) and "Python 3.10 or newer is needed: make PYTHON=...")
EXTENSIONS := simple-knn fused-ssim diff-gaussian-rasterization
CXX_TESTS := $(patsubst submodules/%.cpp,build/%,$(wildcard submodules/*/csrc/tests/*.cpp))
CXX_TEST_OBJECTS := $(patsubst submodules/%.cpp,build/%.o,$(wildcard submodules/*/csrc/cpu/*.cpp))
CXX_PLATFORM_TESTS := $(patsubst submodules/%.cpp,build/%.o,$(wildcard submodules/*/csrc/tests/platforms/*.cpp))
CORES := $(shell nproc 2> /dev/null || getconf _NPROCESSORS_ONLN)
CXX_TEST_FLAGS := -std=c++17 -O1 -g1 -Wall -Wextra -Werror -fsanitize=address,undefined -fno-sanitize-recover=all -pthread

CXX_SOURCES := $(shell find submodules -name build -prune -o \( -name '*.cpp' -o -name '*.cu*' -o -name '*.h' \) -print)
# What the extension $(1) is built from.
sources = $(shell find submodules/common submodules/$(1) \( -name build -o -name tests -o -name emulation \) -prune -o \
            \( -name '*.cpp' -o -name '*.cu*' -o -name '*.h' -o -name '*.py' -o -name '*.toml' \) -print)

.PHONY: install demo test check test-aarch64 test-windows test-macos test-browser test-foreign lint format cpp-test docs wheels gate clean
.NOTPARALLEL:

install: $(EXTENSIONS:%=$(VENV)/.built-%)

$(VENV)/.requirements: requirements.txt requirements-dev.txt
	@$(PYTHON) -c '$(CHECK_PYTHON)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	@touch $@

.SECONDEXPANSION:
$(VENV)/.built-%: $(VENV)/.requirements version.txt $$(call sources,$$*)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation ./submodules/$*
	@touch $@

demo: install output/demo_scene
	$(BIN)/python train.py -s output/demo_scene -m output/demo --eval --iterations 1500 --test_iterations 1500
	$(BIN)/python render.py -m output/demo --skip_train
	$(BIN)/python metrics.py -m output/demo
	$(BIN)/python -m splatting.demo.report output/demo

output/demo_scene: | install
	$(BIN)/python -m splatting.demo.make_scene $@

test: CHOSEN := not browser and not slow
check: CHOSEN := not browser
test check: install lint cpp-test
	$(BIN)/python -m pytest -m '$(CHOSEN)' --numprocesses $(shell expr $(CORES) + 1) --maxprocesses 5 --dist worksteal

test-aarch64 test-windows test-macos:
	$(PYTHON) .ci/cross.py $(@:test-%=%)

test-browser: install
	tests/browser/install.sh
	$(BIN)/python -m pytest -m browser tests/browser

test-foreign: install
	@if command -v npm > /dev/null; then cd tests/foreign && npm ci --ignore-scripts --no-audit --no-fund --silent; fi
	$(BIN)/python -m pytest tests/test_exports_foreign.py

lint: $(VENV)/.requirements
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run -Werror $(CXX_SOURCES)
	PATH="$(CURDIR)/$(BIN):$$PATH" .ci/lint

format: $(VENV)/.requirements
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_SOURCES)

# A process a core builds an object or a test; a test that is built is run at once. The longest take minutes.
in_parallel = printf '%s\n' $(1) | xargs -P $(CORES) -I TARGET sh -c '$(MAKE) --no-print-directory TARGET $(2)'
cpp-test:
	@$(call in_parallel,$(CXX_TEST_OBJECTS) $(CXX_PLATFORM_TESTS))
	@$(call in_parallel,$(CXX_TESTS),&& TARGET)

# Compiles for the submodule $(1); sources and more flags follow.
compile = $(CXX) $(CXX_TEST_FLAGS) -Isubmodules/$(1)/csrc -Isubmodules/common/include -Isubmodules/common/tests
# The submodule of build/SUBMODULE/..., and its objects.
submodule = $(firstword $(subst /, ,$(1)))
objects = $(filter build/$(1)/%,$(CXX_TEST_OBJECTS))

build/%.o: submodules/%.cpp $$(call sources,$$(call submodule,$$*))
	@mkdir -p $(@D)
	$(call compile,$(call submodule,$*)) $< -c -o $@

build/%: submodules/%.cpp $$(call objects,$$(call submodule,$$*)) $$(wildcard submodules/$$(dir $$*)*.h)
	@mkdir -p $(@D)
	$(call compile,$(call submodule,$*)) $< $(call objects,$(call submodule,$*)) -o $@

# CUDA kernels on the CPU: the .cu files, rewritten as C++, instead of a GPU.
EMULATION := submodules/common/emulation
build/%/csrc/tests/test_cuda_emulated: submodules/%/csrc/tests/test_cuda_emulated.cpp $(wildcard $(EMULATION)/*) \
                                       $(wildcard $(EMULATION)/gs/*) $$(call objects,$$*) \
                                       $$(wildcard submodules/$$*/csrc/tests/*.h)
	@mkdir -p $(@D)/emulated
	rm -f $(@D)/emulated/*
	$(PYTHON) $(EMULATION)/translate.py $(@D)/emulated $(wildcard submodules/$*/csrc/cuda/*.cu*)
	printf '%s\n' $< $(EMULATION)/emulation.cpp $(@D)/emulated/*.cpp | xargs -P $(CORES) -I SOURCE sh -c \
	    '$(call compile,$*) -Wno-unknown-pragmas -I$(@D)/emulated -Isubmodules/$*/csrc/cuda -I$(EMULATION) -iquote$(EMULATION) \
	    SOURCE -c -o $(@D)/emulated/$$(basename SOURCE).o'
	$(CXX) $(CXX_TEST_FLAGS) $(@D)/emulated/*.o $(call objects,$*) -o $@

wheels: $(VENV)/.requirements
	.ci/wheels $(BIN)/python

gate: install
	$(BIN)/python -m benchmarks.gate

docs: $(DOCS_VENV)/.requirements
	NO_MKDOCS_2_WARNING=true $(DOCS_VENV)/bin/mkdocs build --strict

$(DOCS_VENV)/.requirements: requirements-docs.txt
	@$(PYTHON) -c '$(CHECK_PYTHON)'
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/pip install --quiet --disable-pip-version-check -r $<
	@touch $@

clean:
	rm -rf $(VENV) $(DOCS_VENV) build submodules/*/build submodules/*/*.egg-info
