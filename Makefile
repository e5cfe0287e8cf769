# Everything is one command; every command first builds .venv from requirements.lock.
SCALE ?= laptop
DATA  ?= shapes
ROOT  ?=
NAME  ?=
ARGS  ?=
LAUNCHER ?=
PYTHON ?= python3
UV_VERSION := 0.13.9

export PYTHONUNBUFFERED := 1
unexport PYTHONDONTWRITEBYTECODE  # without byte code every command takes seconds longer
BIN := .venv/bin
EXPERIMENTS := exp1.1 exp1.2 exp1.3 exp1.4 exp2.1 exp2.2 exp2.3 exp2.4 exp3.1 exp3.2 exp3.3
OPTIONS = --scale $(SCALE) --data.data $(DATA) $(if $(ROOT),--data.root "$(ROOT)") $(if $(NAME),--data.name "$(NAME)")
# What a cluster has trained anew is not trained a second time to be tested.
RUN_OPTIONS = $(OPTIONS) $(if $(filter ray,$(LAUNCHER)),$(filter-out --fresh,$(ARGS)),$(ARGS))

IN_PARALLEL := --numprocesses auto --maxprocesses 8 --dist worksteal --nbmake notebooks tests
.PHONY: help $(EXPERIMENTS) outliers robustness all on-ray rates weights verification calibration checkpoints protocols docs docs-site report bench lint format test test-slow test-oldest lock clean

help:  ## list the targets
	@echo "make TARGET [SCALE=smoke|laptop|overnight|paper] [DATA=shapes|modelnet40|folder] [ROOT=folder] [NAME=chairs] [ARGS='--key value']"
	@grep -hE '^[a-z$$()_A-Z0-9.-]+:.*##' $(MAKEFILE_LIST) | sed 's/\$$(EXPERIMENTS)/exp1.1 ... exp3.3/; s/:.*##/\t/' | expand -t 22

$(EXPERIMENTS): exp%: .venv/ready  ## train both arms of an experiment, print ours beside the paper's
	$(BIN)/python reproduce/exp$(subst .,_,$*).py $(RUN_OPTIONS)

outliers: .venv/ready  ## DCP with outliers, three ways to their class (supplement B)
	$(BIN)/python reproduce/outliers.py $(RUN_OPTIONS)

robustness: .venv/ready  ## figure 2: wrong matches against a wrong rotation vector, in seconds
	$(BIN)/python reproduce/robustness.py --scale $(SCALE) $(if $(filter all,$(MAKECMDGOALS)),,$(ARGS))

all: $(if $(filter ray,$(LAUNCHER)),on-ray) robustness $(EXPERIMENTS) outliers  ## every experiment, figure 2 first; LAUNCHER=ray trains on a cluster

on-ray: .venv/ready
	$(BIN)/python reproduce/on_ray.py $(OPTIONS) $(ARGS)

rates: .venv/ready  ## three learning rates for every arm, a twentieth of SCALE's training each
	$(BIN)/python reproduce/rates.py $(OPTIONS) $(ARGS)

weights: .venv/ready  ## train what `corrmat register` ships on the embedded shapes, put it into the package
	$(BIN)/python reproduce/weights.py --scale $(SCALE) $(ARGS)

verification: .venv/ready  ## train the network that chooses among candidates, for the weights that ship; two hours
	$(BIN)/python reproduce/verification.py $(ARGS)

calibration: .venv/ready  ## fit the confidence of the shipped weights anew (after a change of the choice, not of the weights)
	$(BIN)/python reproduce/calibration.py

checkpoints: .venv/ready  ## put the trained arms of SCALE's records into the package: corrmat.load_model("1.2/DCP_corr")
	$(BIN)/python reproduce/checkpoints.py $(OPTIONS)

protocols: .venv/ready  ## the shipped weights beside the classical pipelines (needs the extra baselines), into results/register
	$(BIN)/python benchmarks/protocols.py $(if $(ROOT),--root "$(ROOT)")

docs: .venv/ready  ## rewrite the documents' tables, redraw the pictures of docs/ and results/, from results/
	$(BIN)/corrmat report --docs .
	$(BIN)/corrmat data --sheet docs/shapes.png
	$(BIN)/corrmat example runs/example > /dev/null
	$(BIN)/corrmat register runs/example/source.ply runs/example/target.ply --gif docs/register.gif

docs-site: .venv/ready  ## README and docs/ as a site in build/site; a broken link is an error
	rm -rf build/site-source && mkdir -p build/site-source
	tar cf - *.md CITATION.cff docs notebooks src/corrmat/shipped/MODEL_CARD.md \
		$$(grep -oh 'results/[^)]*' docs/*.md | grep -E '\.(png|json)$$' | sort -u) \
		| tar xf - -C build/site-source
	mv build/site-source/README.md build/site-source/index.md
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

report: .venv/ready  ## report.html: every record on one page
	$(BIN)/corrmat report -o report.html

bench: .venv/ready  ## speed: pairs a second, training steps, ratios against a naive twin
	$(BIN)/python benchmarks/bench.py $(ARGS)

lint: .venv/ready docs-site  ## ruff, pyright, codespell, the order of imports, and the links of the site
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright && $(BIN)/lint-imports && $(BIN)/codespell

format: .venv/ready  ## let ruff rewrite what it can
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

test: .venv/ready  ## everything but the slow learning tests, smoke training of every experiment included
	$(BIN)/pytest $(IN_PARALLEL)

test-slow: .venv/ready  ## learning, kill -9 at any moment, SLURM, Ray, all checksums
	$(BIN)/pytest -m slow

test-oldest: .venv/ready  ## make test on the oldest versions that pyproject.toml allows
	$(BIN)/uv venv --clear --quiet --python $(BIN)/python .venv-oldest
	$(BIN)/uv pip install --quiet --python .venv-oldest/bin/python --resolution lowest-direct '.[dev]'
	.venv-oldest/bin/python -m pytest $(IN_PARALLEL)

lock: .venv/ready  ## compile requirements.lock anew from pyproject.toml
	$(BIN)/uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 \
		--generate-hashes --no-header --quiet --upgrade --no-emit-index-url --output-file requirements.lock

clean:  ## remove the environment and all runs (results/ stays)
	rm -rf .venv .venv-oldest runs

# Where there is no GPU: PyTorch without CUDA, if its own index answers (1.5 GB on disk instead of 6).
TORCH_WITHOUT_CUDA = [ "$$(uname)" = Linux ] && ! command -v nvidia-smi > /dev/null 2>&1 \
	&& UV_HTTP_RETRIES=0 $(BIN)/uv pip install --quiet --python $(BIN)/python --torch-backend cpu \
		--no-deps "$$(grep -o '^torch==[^ ]*' requirements.lock)" 2> /dev/null

.venv/ready: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "corrmat needs Python 3.11 or newer; name one with PYTHON=...")'
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
	@echo "installing PyTorch and the other packages: 1.5 GB, or 6 GB with CUDA; a minute or more"
	@if $(TORCH_WITHOUT_CUDA); then \
		awk '/^[a-z]/ {keep = !/^(cuda|nvidia|torch|triton)[-=]/} keep' requirements.lock; \
	else cat requirements.lock; fi > .venv/requirements.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps --require-hashes -r .venv/requirements.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-build-isolation --no-deps --editable .
	@$(BIN)/corrmat run --help > /dev/null  # writes the byte code of torch and lightning
	@touch $@
