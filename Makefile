# make demo: pictures and videos into demo/.
# make test: the tests, on all cores; make test ALL=1: with those that take long.
# make docs: the site into build/docs/, warnings are errors.
# make asan: the tests under the address and undefined-behaviour sanitizers.
# make tsan: the tests of eight threads under the thread sanitizer.
# make bits: the same images on a CPU without AVX2 and FMA (needs qemu-user).
# make paper: the paper's figures, quickly, into paper/; make bench: times.
# make soak MINUTES=40: stream simulated data, watch memory, handles and drift.
# make oldest, make newest: the tests with the oldest and the newest dependencies; also
#   with ALL=1.
# make twice: the wheel, built twice, is the same to the bit.
# Each makes .venv (or its own) first, with any python3 >= 3.11 that it finds.

VENV := .venv
SOURCES := pyproject.toml setup.py $(wildcard _kernels/*.pyx _kernels/*.pxd _kernels/*.h)
export PATH := $(CURDIR)/$(VENV)/bin:$(PATH)

# Real recordings: the first of these folders that exists.
export PDAVIS_TEST_DATA := $(shell for d in "$$PDAVIS_TEST_DATA" ../shared/data \
	shared/data; do [ -d "$$d" ] && cd "$$d" && pwd && break; done)

.PHONY: demo test paper bench docs asan tsan bits fuzz soak twice oldest newest clean

# One more than there are cores: some tests wait for time to pass.
WORKERS := $(shell expr $$(nproc 2>/dev/null || echo 2) + 1)

demo: $(VENV)/.with-cv2
	$(VENV)/bin/pdavis demo -o demo --progress

# There is a worker for each core; BLAS's threads would wait, busily, for each other.
test: export OPENBLAS_NUM_THREADS := 1
test: $(VENV)/.with-$(if $(ALL),lab,test)
	$(VENV)/bin/pytest -q -n $(WORKERS) --dist worksteal $(if $(ALL),-m '' tests lab/tests)

docs: $(VENV)/.with-docs
	$(VENV)/bin/python -P -m sphinx -W --keep-going -q -j auto docs build/docs
	@echo "build/docs/index.html"

# make fuzz MINUTES=60: read damaged recordings, and valid ones with a lie, for so long
fuzz: MINUTES ?= 1
fuzz: $(VENV)/.with-test
	$(VENV)/bin/python -P lab/fuzz/fuzz.py --seconds $$((60 * $(MINUTES)))

paper: $(VENV)/.with-lab
	mkdir -p paper
	$(VENV)/bin/python -m lab.paper all --quick -o paper/all --progress

bench: $(VENV)/.with-lab
	$(VENV)/bin/python -m lab.bench

soak: MINUTES ?= 40
soak: $(VENV)/.with-test
	$(VENV)/bin/python -m lab.soak --minutes $(MINUTES)

twice:
	.ci/twice

oldest newest:
	.ci/ends $@ $(if $(ALL),-m '' tests)

asan tsan: $(SOURCES)
	.ci/sanitize $@

bits: $(VENV)/.with-test
	.ci/bits

$(VENV)/.with-%: $(SOURCES) .ci/venv
	.ci/venv $(VENV) $*
	touch $@

clean:
	rm -rf build dist demo paper $(VENV) _kernels/*.so *.egg-info
