# Poise on a plain Python image:
#   docker build -t poise .
#   docker run --rm --user "$(id -u)" -v "$PWD":/data poise demo
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY src ./src
RUN pip wheel --no-cache-dir --no-deps -w /dist .

FROM python:3.11-slim
# Further options of pip, such as where a CPU build of PyTorch is, which is several GB smaller:
#   docker build --build-arg PIP_OPTIONS="--find-links URL" -t poise .
ARG PIP_OPTIONS=""
COPY constraints.txt /dist/
COPY --from=build /dist /dist
RUN pip install --no-cache-dir ${PIP_OPTIONS} -c /dist/constraints.txt /dist/*.whl && rm -r /dist
WORKDIR /data
ENTRYPOINT ["poise"]
CMD ["--help"]
