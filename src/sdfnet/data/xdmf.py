"""The .xdmf beside a trajectory: how ParaView and meshio find its frames in the HDF5 file."""

from xml.etree import ElementTree

import h5py
import numpy as np

from sdfnet.physics.trajectory import Trajectory

FRAME = "/frames/{:05d}"  # in a trajectory's file


def show_frame(file: h5py.File, frame: int) -> None:
    """A frame's displacements as a dataset of its own, without a copy: meshio reads no part of a dataset."""
    frames, *shape = file["displacements"].shape
    layout = h5py.VirtualLayout(tuple(shape), dtype=np.float64)
    layout[...] = h5py.VirtualSource(".", "displacements", (frames, *shape))[frame]
    file.create_virtual_dataset(FRAME.format(frame), layout).parent.attrs["unit"] = file["displacements"].attrs["unit"]


def xdmf(file_name: str, trajectory: Trajectory) -> ElementTree.ElementTree:
    """One grid per frame, all reading the same nodes and tets from the HDF5 file; load cases are played one after the other."""
    frames, nodes, _ = trajectory.displacements.shape
    root = ElementTree.Element("Xdmf", Version="3.0")
    series = ElementTree.SubElement(ElementTree.SubElement(root, "Domain"), "Grid", Name="trajectory", GridType="Collection", CollectionType="Temporal")

    def item(parent: ElementTree.Element, dimensions: str, number: str, text: str) -> None:
        precision = {"Float": "8", "Int": "8"}[number]
        ElementTree.SubElement(parent, "DataItem", Dimensions=dimensions, NumberType=number, Precision=precision, Format="HDF").text = text

    for frame, moment in enumerate(np.arange(frames) * trajectory.times[1] if trajectory.cases else trajectory.times):
        grid = ElementTree.SubElement(series, "Grid", Name="solid", GridType="Uniform")
        ElementTree.SubElement(grid, "Time", Value=f"{moment:.9g}")
        tets = len(trajectory.mesh.tets)
        item(ElementTree.SubElement(grid, "Topology", TopologyType="Tetrahedron", NumberOfElements=str(tets)), f"{tets} 4", "Int", f"{file_name}:/tets")
        item(ElementTree.SubElement(grid, "Geometry", GeometryType="XYZ"), f"{nodes} 3", "Float", f"{file_name}:/nodes")
        attribute = ElementTree.SubElement(grid, "Attribute", Name="displacement", AttributeType="Vector", Center="Node")
        item(attribute, f"{nodes} 3", "Float", f"{file_name}:{FRAME.format(frame)}")
    ElementTree.indent(root)
    return ElementTree.ElementTree(root)
