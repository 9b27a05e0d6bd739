# The project on the FEniCSx project's own image. Build in the repository's root:
#   docker build -f environment/fenicsx.Dockerfile -t tfeti_dolfinx:fenicsx .
ARG DOLFINX=v0.10.0
FROM ghcr.io/fenics/dolfinx/dolfinx:${DOLFINX}
ENV DEB_PYTHON_INSTALL_LAYOUT=deb_system OMP_NUM_THREADS=1
COPY . /opt/tfeti_dolfinx
WORKDIR /opt/tfeti_dolfinx
# hadolint ignore=DL3013
RUN python3 -m pip install --no-cache-dir --break-system-packages ".[gmsh,plot,progress,test]"
