# tiface with every feature, for CPUs and for GPUs by Vulkan:
#
#     docker build -t tiface .
#     docker run --rm -v "$PWD:/data" -w /data tiface run captures/002_00
#
# On NVIDIA add `--gpus all -e NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility`,
# on others `--device /dev/dri`.
FROM rust:1.95-bookworm AS build
WORKDIR /build
COPY Cargo.toml Cargo.lock rust-toolchain* ./
COPY benches benches
COPY examples examples
COPY crates crates
COPY src src
COPY docs docs
COPY README.md LICENSE-* ./
RUN cargo build --release --locked --features wgpu,matting --bin tiface

FROM debian:bookworm-slim
RUN apt-get update && apt-get install -y --no-install-recommends libvulkan1 mesa-vulkan-drivers ffmpeg \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /build/target/release/tiface /usr/local/bin/tiface
# whoever mounts a folder owns what is made in it: docker run --user "$(id -u):$(id -g)"
ENV XDG_CACHE_HOME=/tmp/cache
ENTRYPOINT ["tiface"]
