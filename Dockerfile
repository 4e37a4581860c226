# CPU:  docker build -t vg2gt --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cpu .
# CUDA: docker build -t vg2gt .   and   docker run --gpus all (torch's wheels bring CUDA; the host needs the driver and
#       nvidia-container-toolkit). Then: docker run -v $PWD:/data vg2gt reconstruct photos/ --out scene
FROM python:3.11-slim
ARG TORCH_INDEX=https://pypi.org/simple
# Triton compiles its kernels' launchers; git tells where the build comes from.
RUN apt-get update && apt-get install -y --no-install-recommends gcc g++ git && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir "torch>=2.6,<=2.13.0" --index-url "$TORCH_INDEX"
COPY . /src
RUN pip install --no-cache-dir "/src[colmap,video,hub]" && rm -rf /src
ENV VG2GT_CACHE=/cache
VOLUME /cache
WORKDIR /data
ENTRYPOINT ["vg2gt"]
CMD ["doctor"]
