# sgstore on the command line: docker build -t sgstore . && docker run --rm -v "$PWD:/data" sgstore demo
FROM python:3.11-slim

WORKDIR /src
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY docs/description.md docs/
COPY sgstore sgstore
RUN pip install --no-cache-dir '.[viz,arrow,fast]' && rm -rf /src

RUN useradd --create-home sgstore
USER sgstore
WORKDIR /data
ENTRYPOINT ["sgstore"]
CMD ["--help"]
