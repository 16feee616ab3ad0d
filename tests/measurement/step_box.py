"""A STEP file (AP214) of a box, written entity by entity."""

from __future__ import annotations

FACES = (
    ((0, 1, 3, 2), (-1, 0, 0), (0, 1, 0)),
    ((4, 6, 7, 5), (1, 0, 0), (0, 1, 0)),
    ((0, 4, 5, 1), (0, -1, 0), (1, 0, 0)),
    ((2, 3, 7, 6), (0, 1, 0), (1, 0, 0)),
    ((0, 2, 6, 4), (0, 0, -1), (1, 0, 0)),
    ((1, 5, 7, 3), (0, 0, 1), (1, 0, 0)),
)
"""Corners in their order seen from outside, normal, a direction in the face."""


class Entities:
    """Numbered rows of the DATA section."""

    def __init__(self):
        self.rows = []

    def add(self, text):
        self.rows.append(text)
        return f"#{len(self.rows)}"

    def point(self, p):
        return self.add(f"CARTESIAN_POINT('',({p[0]:.6f},{p[1]:.6f},{p[2]:.6f}))")

    def direction(self, d):
        return self.add(f"DIRECTION('',({d[0]:.1f},{d[1]:.1f},{d[2]:.1f}))")

    def placement(self, p, z, x):
        return self.add(f"AXIS2_PLACEMENT_3D('',{self.point(p)},{self.direction(z)},{self.direction(x)})")


def step_box(size, prefix=".MILLI."):
    """Text of a box from the origin; lengths in the unit of the prefix, `$` for metres."""
    e = Entities()
    corners = [(x * size[0], y * size[1], z * size[2]) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    vertices = [e.add(f"VERTEX_POINT('',{e.point(c)})") for c in corners]
    curves = {}

    def edge(i, j):
        if (j, i) in curves:
            return e.add(f"ORIENTED_EDGE('',*,*,{curves[j, i]},.F.)")
        way = [b - a for a, b in zip(corners[i], corners[j], strict=True)]
        length = sum(abs(x) for x in way)
        vector = e.add(f"VECTOR('',{e.direction([x / length for x in way])},1.0)")
        line = e.add(f"LINE('',{e.point(corners[i])},{vector})")
        curves[i, j] = e.add(f"EDGE_CURVE('',{vertices[i]},{vertices[j]},{line},.T.)")
        return e.add(f"ORIENTED_EDGE('',*,*,{curves[i, j]},.T.)")

    faces = []
    for loop, normal, along in FACES:
        edges = ",".join(edge(loop[k], loop[(k + 1) % 4]) for k in range(4))
        ring = e.add(f"EDGE_LOOP('',({edges}))")
        bound = e.add(f"FACE_OUTER_BOUND('',{ring},.T.)")
        plane = e.add(f"PLANE('',{e.placement(corners[loop[0]], normal, along)})")
        faces.append(e.add(f"ADVANCED_FACE('',({bound}),{plane},.T.)"))
    shell = e.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    solid = e.add(f"MANIFOLD_SOLID_BREP('',{shell})")
    mm = e.add(f"(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT({prefix},.METRE.))")
    rad = e.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    sr = e.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    close = e.add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),{mm},'distance_accuracy_value','')")
    context = e.add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({close}))"
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({mm},{rad},{sr}))REPRESENTATION_CONTEXT('',''))"
    )
    shape = e.add(
        f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({e.placement((0, 0, 0), (0, 0, 1), (1, 0, 0))},{solid}),{context})"
    )
    design = e.add("APPLICATION_CONTEXT('automotive design')")
    e.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{design})")
    part = e.add(f"PRODUCT_CONTEXT('',{design},'mechanical')")
    product = e.add(f"PRODUCT('box','box','',({part}))")
    formation = e.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    stage = e.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{design},'design')")
    definition = e.add(f"PRODUCT_DEFINITION('design','',{formation},{stage})")
    of_product = e.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    e.add(f"SHAPE_DEFINITION_REPRESENTATION({of_product},{shape})")
    head = (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    )
    return head + "\n".join(f"#{k}={r};" for k, r in enumerate(e.rows, 1)) + "\nENDSEC;\nEND-ISO-10303-21;\n"
