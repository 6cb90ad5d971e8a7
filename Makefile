# make demo            install into its own virtual environment, simulate the paper's team, localise it, draw it
# make demo LOG=path   the same on a log of yours
# make test            install and run all tests
# make check           what CI checks besides: style, types, formatting
# make sanitize        the whole suite on a core built with AddressSanitizer and UBSan

PYTHON ?= python3
VENV ?= .venv
LOG ?=
PYTEST_ARGS ?=

SOURCES := pyproject.toml CMakeLists.txt $(shell find src cpp -name '*.py' -o -name '*.pyi' -o -name '*.cpp' -o -name '*.hpp')
FORMATTED := $(shell find cpp -name '*.cpp' -o -name '*.hpp')

.PHONY: demo test check sanitize clean

demo: $(VENV)/.demo
	$(VENV)/bin/dgorl demo $(if $(LOG),--log "$(LOG)")
	@echo
	@echo "To go on: . $(VENV)/bin/activate    and then: dgorl --help    or, without it: $(VENV)/bin/dgorl --help"

test: $(VENV)/.dev
	$(VENV)/bin/python -m pytest $(PYTEST_ARGS)

check: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/clang-format --dry-run --Werror $(FORMATTED)

# Python itself is not instrumented: it has to load the runtime first, and its own leaks are not ours.
sanitize: $(VENV)-sanitize/.dev
	LD_PRELOAD="$$(c++ -print-file-name=libasan.so) $$(c++ -print-file-name=libstdc++.so)" ASAN_OPTIONS=detect_leaks=0 \
	    UBSAN_OPTIONS=print_stacktrace=1 $(VENV)-sanitize/bin/python -m pytest $(PYTEST_ARGS)

$(VENV)/.demo: $(SOURCES)
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet ".[plot]"
	touch $@

$(VENV)/.dev: $(SOURCES)
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet ".[dev]"
	touch $@ $(VENV)/.demo

$(VENV)-sanitize/.dev: $(SOURCES)
	test -x $(VENV)-sanitize/bin/python || $(PYTHON) -m venv $(VENV)-sanitize
	$(VENV)-sanitize/bin/python -m pip install --quiet ".[test]" \
	    --config-settings=cmake.define.DGORL_SANITIZE=ON --config-settings=build-dir=build/sanitize
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-sanitize build dist out
