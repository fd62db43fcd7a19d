# The package on a plain CPU. In a checkout:
#   docker build --tag arena-newton .
#   docker run --rm --volume "$PWD/results:/arena/results" arena-newton eval --out results/first
FROM python:3.12.12-slim-bookworm AS wheel
RUN pip install --no-cache-dir hatchling==1.27.0
COPY . /source
WORKDIR /source
RUN hatchling build --target wheel --directory /wheels

FROM python:3.12.12-slim-bookworm
RUN pip install --no-cache-dir torch==2.11.0 torchvision==0.26.0 --index-url https://download.pytorch.org/whl/cpu
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && useradd --uid 1000 --create-home arena && install --directory --owner arena /arena
USER 1000
WORKDIR /arena
ENTRYPOINT ["arena-newton"]
CMD ["--help"]
