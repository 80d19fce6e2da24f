"use strict";
(async () => {
  const { THREE, data, find, make, note, unpack, canvas, renderer, scene, camera, controls, dark, ground, ink, rgb, css, ramp, surface, ball, sensorAt, follow } = await makeStage();
  const live = data.live, film = data.film === true ? null : data.film;
  let asked = false;
  function draw() {
    if (asked || !renderer) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const wide = 2 * Math.floor(canvas.clientWidth / views() / 2); // even: edges are shaded by pairs of pixels
      for (let n = 0; n < views(); n++) {
        for (const [name, made] of Object.entries(layers)) made.visible = shows(n, name);
        renderer.setViewport(n * wide, 0, wide, canvas.clientHeight);
        renderer.setScissor(n * wide, 0, wide, canvas.clientHeight);
        renderer.render(scene, camera);
      }
    });
  }
  controls.addEventListener("change", draw);

  // What a layer shows decides how it looks; layers of predictions stand after all others.
  const PLAIN = {
    observed: [230, 75, 0], free: [120, 190, 230], unknown: [196, 176, 140], missed: data.colours.missed,
    invented: dark ? [235, 235, 235] : data.colours.invented, // which a dark ground would hide
    movers: data.colours.movers, ghosts: data.colours.ghosts,
  };
  const RAYS = [70, 110, 150];
  // Okabe and Ito (2008), which colour-blind readers tell apart, then Tol's light colours; in the
  // order in which classes appear.
  const CLASSES = [
    [230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [0, 114, 178], [213, 94, 0], [204, 121, 167], [110, 110, 110],
    [153, 221, 255], [68, 187, 153], [170, 170, 0], [238, 221, 136], [238, 136, 102], [255, 170, 187], [119, 170, 221], [221, 221, 221],
  ];
  const known = new Map(); // classes that have a colour
  const classColour = (name) => {
    if (!known.has(name)) known.set(name, CLASSES[known.size % CLASSES.length]);
    return known.get(name);
  };
  const CLEAR = { free: 0.12, unknown: 0.1 };
  // a server may have samples with any layer; a file has those of its samples
  const holds = (part) => live || data.samples.some((one) => one[part]);
  const kinds = new Map([...(holds("points") ? ["points", "rays"] : []), ...data.masks].map((name) => [name, name]));
  if (kinds.has("observed") && kinds.has("free")) kinds.set("unknown", "unknown");
  if (holds("tudf")) kinds.set("distances", "distances");
  if (holds("classes")) kinds.set("classes", "classes");
  const methods = new Map(data.methods), rows = new Map(), owners = new Map();
  for (const name of methods.keys()) {
    kinds.set(name, "predicted");
    for (const kind of ["doubt", "missed", "invented", "distances"]) {
      kinds.set(`${name}: ${kind}`, kind);
      owners.set(`${name}: ${kind}`, name);
    }
  }
  if (methods.size) kinds.set("paths", "paths");
  if (holds("triangles")) kinds.set("world", "world");
  if (holds("movers")) kinds.set("movers", "movers");
  if (live || data.samples.some((one) => one.movers?.scans.length > 1)) kinds.set("ghosts", "ghosts");
  const names = [...kinds.keys()];
  // Side by side, each view shows one of these sets of layers besides those that are checked.
  const shared = (name) => ["points", "rays", "paths", "world", "movers"].includes(kinds.get(name));
  const sets = new Map(names.filter((name) => !shared(name)).map((name) => [name, [name]]));
  for (const name of methods.keys()) sets.set(`${name}: errors`, [name, `${name}: missed`, `${name}: invented`]);
  // What the page tells first, and what its buttons tell next: sets of layers.
  const [first] = methods.keys(), told = new URLSearchParams(location.hash.slice(1));
  const stories = {};
  const story = (name, ...wanted) => {
    const known = wanted.filter((one) => kinds.has(one));
    if (known.length) stories[name] = known;
  };
  const routed = data.samples.some((one) => one.guesses.some((guess) => guess.route));
  if (!kinds.has("observed")) story("truth", ...(kinds.has("world") ? ["world"] : ["occupancy"]), "movers");
  if (kinds.has("observed")) story("seen", "observed", kinds.has("occupancy") ? "occupancy" : "points", "movers", "ghosts");
  // what a method doubts is transparent, where it says so
  const doubted = live || data.samples.some((one) => one.guesses.some((guess) => guess.name === first && guess.chance));
  if (methods.size) story("believed", "observed", doubted ? `${first}: doubt` : first, "paths");
  if (methods.size && kinds.has("occupancy")) story("wrong", ...sets.get(`${first}: errors`), "paths");
  if (methods.size && (live || routed)) story("planned", "occupancy", "movers", "paths");
  if (kinds.has("observed") && kinds.has("occupancy")) story("truth", "occupancy", "movers");
  const opening = (data.film && stories.believed) || [...Object.values(stories)[0] ?? [], "paths"];
  const shown = new Set(told.get("layers")?.split("~").filter((name) => kinds.has(name)) ?? opening);
  const layers = {};
  function tell(wanted) {
    names.forEach((name, n) => { if (boxes[n].checked !== wanted.includes(name)) boxes[n].click(); });
  }
  for (const [name, wanted] of Object.entries(stories)) {
    find("stories").append(Object.assign(make("button", name), { onclick: () => { split([]); tell(wanted); } }));
  }
  // The names of the views' sets; none where there is one view, which shows what is checked.
  let panes = [];
  const usual = [...(methods.size ? ["observed", first] : ["free", "observed"]), "occupancy"].filter((name) => sets.has(name));
  const views = () => Math.max(panes.length, 1);
  const shows = (view, name) => name.startsWith("#") || shown.has(name) || (sets.get(panes[view]) ?? []).includes(name);
  const wanted = (name) => shown.has(name) || panes.some((_, view) => shows(view, name));
  function split(chosen) {
    panes = chosen;
    find("views").value = views();
    find("panes").replaceChildren(...panes.map((name, n) => {
      const pane = make("div"), pick = make("select");
      pick.ariaLabel = `view ${n + 1}`;
      pick.append(...[...sets.keys()].map((one) => new Option(one, one, false, one === name)));
      pick.onchange = () => split(panes.with(n, pick.value));
      pane.append(pick);
      return pane;
    }));
    document.body.dataset.views = views();
    if (sample) names.forEach(fill);
    resize();
  }
  function beside(count) {
    const kept = [...shown].filter(shared);
    split(count > 1 ? usual.slice(-count) : []);
    tell(panes.length ? kept : [...opening, ...kept]);
  }
  find("views").onchange = ({ target }) => beside(+target.value);
  const boxes = names.map((name, n) => {
    const box = Object.assign(make("input"), { type: "checkbox", checked: shown.has(name), id: `show-${n}` });
    const swatch = make("i"), kind = kinds.get(name);
    const plain = { points: dark ? [230, 233, 237] : [17, 17, 17], rays: RAYS, ...PLAIN }[kind];
    const scales = { distances: data.colours.distances, paths: [...methods.values(), ...methods.values()], classes: CLASSES.slice(0, 7) };
    swatch.style.background = plain ? `rgb(${plain})` : css(scales[kind] ?? data.colours.heights);
    const label = make("label"), owner = owners.get(name);
    label.append(box, swatch, make("span", owner ? kind : n < 9 && kind !== "predicted" ? `${name} (${n + 1})` : name));
    box.onchange = () => {
      box.checked ? shown.add(name) : shown.delete(name);
      if (box.checked && kind === "distances") names.forEach((other, m) => { // which this one would hide
        if (other !== name && kinds.get(other) === kind && shown.has(other)) boxes[m].click();
      });
      // what is drawn otherwise beside this layer
      const beside = { observed: /observed|occupancy|predicted/, movers: /movers|occupancy/, world: /world|movers/ }[name];
      if (sample) (beside ? names.filter((one) => beside.test(kinds.get(one))) : [name]).forEach(fill);
    };
    if (kind === "predicted") {
      const line = Object.assign(make("i"), { className: "line", title: "colour of its path" });
      line.style.background = `rgb(${methods.get(name)})`;
      label.append(line);
      rows.set(name, Object.assign(make("div"), { className: "method" }));
      find("layers").append(rows.get(name));
    }
    (rows.get(owner ?? name) ?? find("layers")).append(label);
    return box;
  });

  let current = -1, sample = null, fields = {}, turn = 0, placed = false;

  const bit = (bits, x, y, z) => {
    const [nx, ny, nz] = sample.shape, n = (x * ny + y) * nz + z;
    return x >= 0 && y >= 0 && z >= 0 && x < nx && y < ny && z < nz && (bits[n >> 3] >> (7 - (n & 7))) & 1;
  };
  const near = []; // steps to the voxels around one, the shortest first
  const { deep } = data.colours, way = Array.from({ length: 2 * deep + 1 }, (_, n) => n - deep);
  for (const x of way) for (const y of way) for (const z of way) {
    if (Math.hypot(x, y, z) < deep) near.push([x, y, z, Math.hypot(x, y, z)]);
  }
  near.sort((one, other) => one[3] - other[3]);

  const touches = (right, x, y, z) => {
    for (let dx = -1; dx < 2; dx++) for (let dy = -1; dy < 2; dy++) for (let dz = -1; dz < 2; dz++) {
      if (bit(right, x + dx, y + dy, z + dz)) return true;
    }
    return false;
  };

  // The colour of an error, the paler the nearer it is to voxels that are right.
  function wrong(colour, right, x, y, z) {
    const away = near.find(([dx, dy, dz]) => bit(right, x + dx, y + dy, z + dz))?.[3] ?? deep;
    const share = data.colours.pale + ((1 - data.colours.pale) * (away - 1)) / (deep - 1);
    return rgb(colour.map((part, n) => ground[n] + share * (part - ground[n])));
  }

  // The faces of a cube: its axis, its side, and its corners along the other axes, seen from outside.
  const FACES = [0, 1, 2].flatMap((axis) => [0, 1].map((side) => {
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]];
    return { axis, side, corners: side ? corners : corners.reverse() };
  }));
  // Edges are drawn by the shader, where cubes are large enough to have some.
  const EDGES = `#include <color_fragment>
    vec2 pixel = fwidth(vEdge), inside = min(vEdge, 1.0 - vEdge) / pixel;
    float edge = (1.0 - smoothstep(0.2, 1.2, min(inside.x, inside.y))) * (1.0 - smoothstep(0.1, 0.35, max(pixel.x, pixel.y)));
    vec3 pen = dot(diffuseColor.rgb, vec3(0.3, 0.6, 0.1)) < 0.03 ? diffuseColor.rgb + 0.12 : 0.4 * diffuseColor.rgb;
    diffuseColor.rgb = mix(diffuseColor.rgb, pen, edge);`;
  function edged(shader) {
    shader.vertexShader = shader.vertexShader.replace("void main() {", "attribute vec2 edge;\nvarying vec2 vEdge;\nvoid main() {\nvEdge = edge;");
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", "varying vec2 vEdge;\nvoid main() {").replace("#include <color_fragment>", EDGES);
  }

  // Cubes as a mesh of those faces that no neighbour hides.
  // cells: x, y, z of each; level: how opaque a voxel is, 0 where there is none; paint: its colour.
  function cubes(cells, level, paint, size, material) {
    const faces = [], at = [0, 0, 0];
    for (let n = 0; n < cells.length; n += 3) {
      const own = level(cells[n], cells[n + 1], cells[n + 2]);
      FACES.forEach(({ axis, side }, face) => {
        for (let m = 0; m < 3; m++) at[m] = cells[n + m];
        at[axis] += side ? 1 : -1;
        if (level(...at) < own) faces.push(n, face);
      });
    }
    const count = faces.length / 2, edge = sample.voxel;
    const position = new Float32Array(12 * count), normal = new Int8Array(12 * count), index = new Uint32Array(6 * count);
    const colour = new Uint16Array(16 * count), corner = new Uint8Array(8 * count), tint = new THREE.Color();
    let painted = -1, opaque = 1;
    for (let n = 0; n < count; n++) {
      const cell = faces[2 * n], { axis, side, corners } = FACES[faces[2 * n + 1]];
      if (cell !== painted) opaque = paint(tint, cells[cell], cells[cell + 1], cells[cell + 2]) ?? 1;
      painted = cell;
      corners.forEach(([u, v], m) => {
        const first = 12 * n + 3 * m, [across, up] = [(axis + 1) % 3, (axis + 2) % 3];
        position[first + axis] = (cells[cell + axis] + 0.5 + (side - 0.5) * size) * edge;
        position[first + across] = (cells[cell + across] + u) * edge;
        position[first + up] = (cells[cell + up] + v) * edge;
        normal[first + axis] = side ? 127 : -127;
        colour.set([65535 * tint.r, 65535 * tint.g, 65535 * tint.b, 65535 * opaque], 16 * n + 4 * m);
        corner.set([u, v], 8 * n + 2 * m);
      });
      index.set([0, 1, 2, 0, 2, 3].map((m) => 4 * n + m), 6 * n);
    }
    const shape = new THREE.BufferGeometry().setIndex(new THREE.BufferAttribute(index, 1));
    shape.setAttribute("position", new THREE.BufferAttribute(position, 3));
    shape.setAttribute("normal", new THREE.BufferAttribute(normal, 3, true));
    shape.setAttribute("color", new THREE.BufferAttribute(colour, 4, true));
    shape.setAttribute("edge", new THREE.BufferAttribute(corner, 2));
    const mesh = new THREE.Mesh(shape, Object.assign(new THREE.MeshLambertMaterial({ vertexColors: true, ...material }), { onBeforeCompile: edged }));
    mesh.userData.voxels = true;
    return mesh;
  }

  const tints = () => Array.from({ length: sample.shape[2] }, (_, z) => rgb(ramp(data.colours.heights, z / Math.max(sample.shape[2] - 1, 1))));
  function cellsWhere(is) {
    const [nx, ny] = sample.shape, nz = cut(), cells = [];
    for (let x = 0; x < nx; x++) for (let y = 0; y < ny; y++) for (let z = 0; z < nz; z++) if (is(x, y, z)) cells.push(x, y, z);
    return cells;
  }

  function voxels(bits, name) {
    const nz = cut(), kind = kinds.get(name), owner = owners.get(name);
    const right = { missed: fields.masks[owner], invented: fields.masks.occupancy }[kind];
    // a shell one voxel thick around what is right is no failure
    const level = right
      ? (x, y, z) => z < nz && bit(bits, x, y, z) && !touches(right, x, y, z)
      : (x, y, z) => z < nz && bit(bits, x, y, z);
    const half = /occupancy|predicted/.test(kind) && shown.has("observed"), clear = CLEAR[kind] ?? (half ? 0.5 : 1);
    const size = kind in CLEAR ? 0.9 : kind === "ghosts" ? 1.04 : kind in PLAIN ? 1.02 : 0.98; // outer ones win
    const heights = tints(), plain = PLAIN[kind] && rgb(PLAIN[kind]);
    const paint = (tint, x, y, z) => void tint.copy(right ? wrong(PLAIN[kind], right, x, y, z) : plain ?? heights[z]);
    return cubes(cellsWhere(level), level, paint, size, { transparent: clear < 1, opacity: clear, depthWrite: !(kind in CLEAR) });
  }

  // Voxels by their probability: those of less than a tenth are left out, others as opaque as likely.
  function doubts(chance) {
    const [nx, ny, n] = sample.shape, nz = cut(), heights = tints();
    const byte = (x, y, z) => (x >= 0 && y >= 0 && z >= 0 && x < nx && y < ny && z < nz ? chance[(x * ny + y) * n + z] : 0);
    const level = (x, y, z) => { const is = byte(x, y, z); return is < 26 ? 0 : 1 + (is >> 5); };
    // the surest first: they hide others, and are seen through them
    const cells = cellsWhere((...at) => level(...at) > 0), order = Array.from({ length: cells.length / 3 }, (_, m) => 3 * m);
    order.sort((one, other) => level(...cells.slice(other, other + 3)) - level(...cells.slice(one, one + 3)));
    const sorted = order.flatMap((m) => cells.slice(m, m + 3));
    const paint = (tint, x, y, z) => { tint.copy(heights[z]); return byte(x, y, z) / 255; };
    return cubes(sorted, level, paint, 0.98, { transparent: true });
  }

  function classed({ voxels: numbers, names }) {
    const [nx, ny, n] = sample.shape, nz = cut();
    const level = (x, y, z) => x >= 0 && y >= 0 && z >= 0 && x < nx && y < ny && z < nz && numbers[(x * ny + y) * n + z] > 0;
    const colours = names.map((name) => fields.classes.counts.get(name) && rgb(classColour(name)));
    return cubes(cellsWhere(level), level, (tint, x, y, z) => void tint.copy(colours[numbers[(x * ny + y) * n + z]]), 0.98, {});
  }

  function lines(from, to, colour, opacity) {
    const ends = new Float32Array(to.length * 2);
    for (let n = 0; n < to.length / 3; n++) {
      ends.set(from, 6 * n);
      ends.set(to.subarray(3 * n, 3 * n + 3), 6 * n + 3);
    }
    const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(ends, 3));
    return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: colour, transparent: true, opacity }));
  }

  function slice(tudf) {
    const axis = +find("axis").value, level = +find("level").value, shape = sample.shape;
    const [u, v] = [0, 1, 2].filter((n) => n !== axis);
    const pixels = new Uint8Array(4 * shape[u] * shape[v]), place = [0, 0, 0];
    place[axis] = level;
    for (let j = 0; j < shape[v]; j++) for (let i = 0; i < shape[u]; i++) {
      place[u] = i;
      place[v] = j;
      const value = tudf[(place[0] * shape[1] + place[1]) * shape[2] + place[2]] / 255;
      pixels.set([...ramp(data.colours.distances, value), 255], 4 * (j * shape[u] + i));
    }
    const texture = new THREE.DataTexture(pixels, shape[u], shape[v]);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.needsUpdate = true;
    const corner = (i, j) => {
      const at = [0, 0, 0];
      at[axis] = (level + 0.5) * sample.voxel;
      at[u] = i * shape[u] * sample.voxel;
      at[v] = j * shape[v] * sample.voxel;
      return at;
    };
    const plane = new THREE.BufferGeometry();
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]];
    plane.setAttribute("position", new THREE.Float32BufferAttribute(corners.flatMap(([i, j]) => corner(i, j)), 3));
    plane.setAttribute("uv", new THREE.Float32BufferAttribute(corners.flat(), 2));
    plane.setIndex([0, 1, 2, 0, 2, 3]);
    return new THREE.Mesh(plane, new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide }));
  }

  const headingOf = ([w, x, y, z]) => Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), heading = () => headingOf(sample.quaternion);
  const large = () => sample.voxel * Math.max(0.02 * Math.max(...sample.shape), 0.5); // of a ball that one should see

  function routes() {
    const all = new THREE.Group(), thick = 0.3 * sample.voxel;
    for (const { name, route } of sample.guesses) {
      if (!route) continue;
      if (!all.children.length) all.add(ball(route.start, 1.1 * large(), data.colours.start), ball(route.goal, large(), data.colours.goal));
      const material = new THREE.MeshLambertMaterial({ color: rgb(methods.get(name)) });
      if (route.hit) all.add(ball(route.hit, 2.4 * thick, data.colours.invented));
      route.points.slice(1).forEach((to, n) => {
        const from = new THREE.Vector3(...route.points[n]), end = new THREE.Vector3(...to);
        const wide = route.flown && n + 1 >= route.flown ? thick / 2.5 : thick; // planned, not flown yet
        all.add(new THREE.Mesh(new THREE.TubeGeometry(new THREE.LineCurve3(from, end), 1, wide, 8), material));
        const joint = new THREE.Mesh(new THREE.SphereGeometry(wide, 8, 6), material);
        joint.position.copy(end);
        all.add(joint);
      });
    }
    for (const { hit } of film?.ends ?? []) { // where flights through this world hit something
      if (hit) all.add(ball(hit.map((value, n) => value - sample.origin[n]), 0.7 * large(), data.colours.invented));
    }
    return all.children.length && all;
  }

  // Movers are drawn as their solids, where their courses have them at a moment: exactly.
  const SOLIDS = { // by MuJoCo's code of the shape, of its sizes
    3: (radius, half) => new THREE.CapsuleGeometry(radius, 2 * half, 8, 24).rotateX(Math.PI / 2),
    4: (...radii) => new THREE.SphereGeometry(1, 32, 16).rotateX(Math.PI / 2).scale(...radii),
    6: (...halves) => new THREE.BoxGeometry(...halves.map((half) => 2 * half)),
  };
  let moment = 0; // seconds after the sample's own time
  // Place and heading of a mover: polynomials of the seconds since a piece of its course began.
  function poseOf({ begin_s: begins, course }) {
    const { now, period } = sample.movers, time = now + moment, since = period ? time - period * Math.floor(time / period) : time;
    const piece = Math.max(begins.findLastIndex((begin) => begin <= since), 0), [x, y, z, ahead, aside] = [0, 4, 8, 12, 16].map((at) =>
      course[piece].slice(at, at + 4).reduceRight((sum, factor) => sum * (since - begins[piece]) + factor, 0));
    return { place: [x, y, z].map((value, n) => value - sample.origin[n]), turn: Math.atan2(aside, ahead) };
  }
  function movers() {
    const all = new THREE.Group(), size = sample.shape.map((count) => count * sample.voxel);
    // beyond the map they are left out, as all else is but the world
    const walls = shown.has("world") ? [] : [0, 1, 2].flatMap((axis) => [1, -1].map((sign) =>
      new THREE.Plane(new THREE.Vector3().setComponent(axis, sign), sign > 0 ? 0 : size[axis])));
    const material = new THREE.MeshLambertMaterial({ color: rgb(PLAIN.movers), side: THREE.DoubleSide, clippingPlanes: [below, ...walls] });
    for (const mover of fields.movers) {
      const body = new THREE.Group();
      for (const [shape, a, b, c, ...centre] of mover.solids) {
        const part = new THREE.Mesh(SOLIDS[shape](a, b, c), material);
        part.position.set(...centre);
        body.add(part);
      }
      all.add(Object.assign(body, { userData: mover }));
    }
    return all;
  }
  function at(time) {
    if (!fields.movers) return;
    const { scans, end } = sample.movers;
    moment = Math.min(Math.max(time, Math.min(...scans)), end);
    find("moment").value = moment;
    find("moment-at").textContent = `${moment.toFixed(2)} s${moment || !sample.sensor ? "" : ", the sample"}`;
    document.body.dataset.moment = moment.toFixed(2);
    for (const body of layers.movers?.children ?? []) {
      const { place, turn } = poseOf(body.userData);
      body.position.set(...place);
      body.rotation.z = turn;
      if (body === layers.movers.children[0]) document.body.dataset.mover = [...place, turn].map((one) => one.toFixed(4)).join(" ");
    }
    keep();
    draw();
  }
  find("moment").oninput = ({ target }) => at(+target.value);
  function timeline() {
    find("moment-row").hidden = !fields.movers;
    if (!fields.movers) return;
    const { scans, end } = sample.movers;
    Object.assign(find("moment"), { min: Math.min(...scans), max: end });
    find("scans").replaceChildren(...scans.map((value) => Object.assign(make("option"), { value })));
    at(+told.get("time") || 0);
    told.delete("time"); // once
  }

  // The world's solids are asked for when they are to be seen.
  async function solids() {
    const of = fields;
    if (of.asked) return;
    of.asked = true;
    const place = `world/${find("dataset").value}/${find("split").value}/${current}`;
    const got = await fetch(place).then((answer) => answer.json()).catch(() => ({ error: "The server does not answer." }));
    if (got.triangles) of.solids = new Float32Array((await unpack(got.triangles)).buffer);
    if (of !== fields) return;
    if (got.error) find("notes").append(make("p", got.error));
    fill("world");
  }

  // What is above the cut is left out, so that one looks into rooms. At first it is above the sensor
  // where most of the map lies under a ceiling.
  const cut = () => +find("cut").value, below = new THREE.Plane(new THREE.Vector3(0, 0, -1));
  if (renderer) renderer.localClippingEnabled = true;
  function ceiling() {
    const [nx, ny, nz] = sample.shape, { occupancy } = fields.masks;
    const above = Math.floor(fields.sensor[2] / sample.voxel) + 1;
    let columns = 0, covered = 0;
    for (let x = 0; occupancy && x < nx; x++) for (let y = 0; y < ny; y++) {
      const highest = Array.from({ length: nz }, (_, n) => nz - 1 - n).find((z) => bit(occupancy, x, y, z));
      columns += highest !== undefined;
      covered += highest >= above;
    }
    return covered > Math.max(0.6 * columns, 0.25 * nx * ny) ? above : nz;
  }
  let cutByHand = false;
  function placeCut() {
    find("cut").max = sample.shape[2];
    if (!cutByHand) find("cut").value = ceiling();
    below.constant = cut() * sample.voxel;
    find("cut-at").textContent = cut() < sample.shape[2] ? `${(sample.origin[2] + below.constant).toFixed(2)} m` : "no cut";
    document.body.dataset.cut = cut();
  }
  find("cut").oninput = () => {
    if (!sample) return;
    cutByHand = true;
    placeCut();
    names.forEach(fill);
  };

  function solid(corners) {
    const high = sample.shape[2] * sample.voxel, shape = surface(corners, (z) => rgb(ramp(data.colours.heights, z / high)));
    return new THREE.Mesh(shape, new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide, clippingPlanes: [below] }));
  }

  function built(name) {
    if (name === "world") return fields.solids ? solid(fields.solids) : live && void solids();
    if (kinds.get(name) === "distances") {
      const tudf = fields.tudf[owners.get(name) ?? "truth"];
      return tudf && slice(tudf);
    }
    if (name === "paths") return routes();
    if (name === "classes") return fields.classes && classed(fields.classes);
    if (kinds.get(name) === "doubt") return fields.chance[owners.get(name)] ? doubts(fields.chance[owners.get(name)]) : wanted(name) && fields.masks[owners.get(name)] && voxels(fields.masks[owners.get(name)], owners.get(name));
    if (name === "points" && fields.points) {
      const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(fields.points, 3));
      return new THREE.Points(shape, new THREE.PointsMaterial({ color: ink, size: 3, sizeAttenuation: false, clippingPlanes: [below] }));
    }
    if (name === "rays" && fields.points) return lines(fields.sensor, fields.points.subarray(0, 3 * sample.own), rgb(RAYS), 0.25);
    if (name === "movers") return fields.movers && movers();
    if (name === "occupancy" && fields.standing && shown.has("movers")) return voxels(fields.standing, name);
    return fields.masks[name] && voxels(fields.masks[name], name);
  }

  function drop(name) {
    const old = layers[name];
    if (!old) return;
    scene.remove(old);
    old.traverse((part) => {
      part.geometry?.dispose();
      part.material?.map?.dispose();
      part.material?.dispose();
      part.dispose?.();
    });
    delete layers[name];
  }

  function fill(name) {
    drop(name);
    const made = renderer && wanted(name) && built(name);
    if (made) scene.add(layers[name] = made);
    if (name === "movers") at(moment);
    if (/classes|doubt|missed|invented|movers|ghosts/.test(kinds.get(name))) legend();
    const axis = +find("axis").value, level = +find("level").value;
    find("at").textContent = `${(sample.origin[axis] + (level + 0.5) * sample.voxel).toFixed(2)} m`;
    document.body.dataset.layers = Object.keys(layers).sort().join(" ");
    document.body.dataset.level = level;
    keep();
    draw();
  }

  function frame() {
    for (const name of ["#box", "#sensor", "#x", "#y", "#z"]) drop(name);
    const size = sample.shape.map((count) => count * sample.voxel);
    const box = new THREE.Box3(new THREE.Vector3(), new THREE.Vector3(...size));
    scene.add(layers["#box"] = new THREE.Box3Helper(box, new THREE.Color(ink)));
    if (sample.sensor) scene.add(layers["#sensor"] = sensorAt(fields.sensor, sample.quaternion, sample.fov, 0.1 * Math.hypot(...size)));
    ["x", "y", "z"].forEach((name, axis) => {
      const sign = Object.assign(make("canvas"), { width: 256, height: 64 }), pen = sign.getContext("2d");
      pen.font = "40px system-ui, sans-serif";
      pen.fillStyle = ink;
      pen.textAlign = "center";
      pen.fillText(`${name} ${+size[axis].toFixed(2)} m`, 128, 46);
      const tag = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(sign) }));
      const wide = 0.22 * Math.max(...size);
      tag.scale.set(wide, wide / 4, 1);
      const out = -0.06 * Math.max(...size);
      tag.position.set(...[[size[0] / 2, out, 0], [size[0] - out, size[1] / 2, 0], [out, out, size[2] / 2]][axis]);
      scene.add(layers[`#${name}`] = tag);
    });
    return size;
  }

  // The address keeps what is shown, and from where.
  let keeping;
  function keep() {
    clearTimeout(keeping);
    keeping = setTimeout(() => {
      const place = [...camera.position.toArray(), ...controls.target.toArray()].map((one) => +one.toFixed(3));
      const now = new URLSearchParams({ sample: current, layers: [...shown].join("~"), camera: place.join("~") });
      if (fields.movers && moment) now.set("time", moment.toFixed(3));
      if (panes.length) now.set("views", panes.join("~"));
      if (live) now.set("dataset", find("dataset").value), now.set("split", find("split").value);
      try { history.replaceState(null, "", `#${now}`); } catch { /* a notebook's frame has no address */ }
    }, 200);
  }
  controls.addEventListener("end", keep);

  // A click on a voxel tells what is known of it.
  let down;
  canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointerup", (event) => {
    if (!sample || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return;
    const { left, top, width, height } = canvas.getBoundingClientRect(), caster = new THREE.Raycaster();
    const across = views() * (event.clientX - left) / width, view = Math.floor(across);
    const at = new THREE.Vector2(2 * (across - view) - 1, 1 - 2 * (event.clientY - top) / height);
    caster.setFromCamera(at, camera);
    const seen = names.filter((name) => layers[name]?.userData.voxels && shows(view, name));
    const [hit] = caster.intersectObjects(seen.map((name) => layers[name]));
    drop("#picked");
    find("picked").textContent = hit ? picked(hit.point.addScaledVector(hit.face.normal, -0.1 * sample.voxel)) : "";
    draw();
  });
  function picked(point) {
    const cell = point.toArray().map((one) => Math.floor(one / sample.voxel)), [, ny, nz] = sample.shape;
    const low = new THREE.Vector3(...cell).multiplyScalar(sample.voxel), box = new THREE.Box3(low, low.clone().addScalar(sample.voxel));
    scene.add(layers["#picked"] = new THREE.Box3Helper(box, rgb(data.colours.sensor)));
    const is = Object.keys(fields.masks).filter((name) => bit(fields.masks[name], ...cell));
    const distances = Object.entries(fields.tudf).map(([name, all]) => {
      if (name === "truth" && fields.certain && !bit(fields.certain, ...cell)) return "truth not certain";
      const value = all[(cell[0] * ny + cell[1]) * nz + cell[2]] / 255;
      return `${name} ${value < 1 ? (value * sample.truncation).toFixed(2) : `${sample.truncation} or more`} m`;
    });
    const number = (cell[0] * ny + cell[1]) * nz + cell[2];
    if (fields.classes?.voxels[number]) is.push(`class ${fields.classes.names[fields.classes.voxels[number]]}`);
    for (const [name, all] of Object.entries(fields.chance)) is.push(`${name} ${Math.round(all[number] / 2.55)} %`);
    const place = cell.map((one, n) => (sample.origin[n] + (one + 0.5) * sample.voxel).toFixed(2));
    return `Voxel ${cell.join(", ")} at ${place.join(", ")} m: ${is.join(", ") || "nothing"}. Distances: ${distances.join(", ")}.`;
  }

  function save(blob, name) {
    const link = Object.assign(make("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    URL.revokeObjectURL(link.href);
  }
  find("png").onclick = () => canvas.toBlob((blob) => save(blob, `sample-${current}.png`));
  // The film is of what plays: all samples from this one on, or the time of its movers.
  find("film").hidden = !globalThis.MediaRecorder;
  find("film").onclick = async () => {
    const recorder = new MediaRecorder(canvas.captureStream(30)), parts = [], first = current;
    recorder.ondataavailable = (part) => parts.push(part.data);
    recorder.onstop = () => save(new Blob(parts, { type: recorder.mimeType }), `samples-${first}.webm`);
    recorder.start();
    draw();
    filming = true;
    await play();
    filming = false;
    recorder.stop();
  };

  function view(top) {
    if (!sample) return;
    const size = sample.shape.map((count) => count * sample.voxel), far = Math.hypot(...size);
    controls.target.set(size[0] / 2, size[1] / 2, size[2] / 2);
    const way = top ? [0, -0.001, 1.3] : [0.53, -0.9, 0.71];
    camera.position.set(...way.map((part, n) => size[n] / 2 + part * far));
    camera.near = far / 1000;
    camera.far = far * 20;
    camera.updateProjectionMatrix();
    controls.update();
    draw();
  }

  // Sample `number`, of a split where there is a server to ask; the last few are kept.
  const kept = new Map();
  function fetched(number) {
    if (!live) return data.samples[number];
    const place = `sample/${find("dataset").value}/${find("split").value}/${number}`;
    const asked = kept.get(place) ?? fetch(place).then((answer) => answer.json()).catch(() => {
      kept.delete(place);
      return { error: "The server does not answer; is scenegen view still running?" };
    });
    kept.delete(place);
    kept.set(place, asked);
    if (kept.size > 8) kept.delete(kept.keys().next().value);
    return asked;
  }

  const splits = () => live.datasets[+find("dataset").value].splits;
  const count = () => (live ? splits()[find("split").value] ?? 0 : data.samples.length);
  const which = find(live ? "number" : data.film ? "time" : "which");

  async function show(number) {
    const began = performance.now(), mine = ++turn;
    number = Math.min(Math.max(number, 0), count() - 1);
    const on = number + Math.sign(number - current); // where one seems to be going
    const next = count() ? await fetched(number) : { error: "This split is empty." };
    if (mine !== turn) return; // another was asked for meanwhile
    if (live) {
      find("notes").replaceChildren();
      [...(next.notes ?? []), ...(next.missing ?? []), ...(next.error ? [next.error] : [])].forEach(note);
    }
    if (next.error) {
      Object.keys(layers).forEach(drop);
      [sample, fields, current] = [null, {}, number];
      timeline();
      which.value = number;
      find("figures").replaceChildren();
      document.body.dataset.sample = current;
      draw();
      return;
    }
    const found = { masks: {}, tudf: {}, chance: {}, sensor: next.position.map((value, n) => value - next.origin[n]) };
    for (const [name, text] of Object.entries(next.masks)) found.masks[name] = await unpack(text);
    const { observed, free, occupancy } = found.masks;
    if (observed && free) found.masks.unknown = observed.map((byte, n) => ~(byte | free[n]));
    if (next.tudf) found.tudf.truth = await unpack(next.tudf);
    if (next.certain) found.certain = await unpack(next.certain);
    const scored = next.scored && await unpack(next.scored);
    for (const { name, mask, tudf, chance } of next.guesses) {
      const bits = found.masks[name] = await unpack(mask);
      if (tudf) found.tudf[name] = await unpack(tudf);
      if (chance) found.chance[name] = await unpack(chance);
      if (!occupancy) continue;
      found.masks[`${name}: missed`] = occupancy.map((byte, n) => byte & ~bits[n] & (scored ? scored[n] : 255));
      found.masks[`${name}: invented`] = bits.map((byte, n) => byte & ~occupancy[n] & (scored ? scored[n] : 255));
    }
    if (next.classes) {
      const numbers = new Uint16Array((await unpack(next.classes.voxels)).buffer), counts = new Map();
      for (const number of numbers) if (number) counts.set(next.classes.names[number], (counts.get(next.classes.names[number]) ?? 0) + 1);
      found.classes = { voxels: numbers, names: next.classes.names, counts };
    }
    if (next.points) {
      const whole = new Int16Array((await unpack(next.points)).buffer);
      found.points = Float32Array.from(whole, (value, n) => (value / 32767) * next.reach + found.sensor[n % 3]);
    }
    if (next.movers) {
      found.movers = JSON.parse(new TextDecoder().decode(await unpack(next.movers.table)));
      found.standing = next.movers.standing && await unpack(next.movers.standing);
      if (next.movers.scans.length > 1 && observed && occupancy) found.masks.ghosts = observed.map((byte, n) => byte & ~occupancy[n]);
    }
    if (next.triangles) found.solids = new Float32Array((await unpack(next.triangles)).buffer);
    if (mine !== turn) return;
    const first = !placed || `${sample?.shape}` !== `${next.shape}`, levels = sample?.shape[+find("axis").value];
    [sample, fields, current, placed] = [next, found, number, true];
    which.value = current;
    names.forEach((name, n) => { // what this sample lacks is no choice
      const kind = kinds.get(name);
      if (kind === "classes") boxes[n].parentElement.hidden = !fields.classes;
      if (kind === "movers") boxes[n].parentElement.hidden = !fields.movers;
      if (kind === "ghosts") boxes[n].parentElement.hidden = !fields.masks.ghosts;
      if (kind === "doubt") boxes[n].parentElement.hidden = !fields.chance[owners.get(name)];
    });
    if (levels !== sample.shape[+find("axis").value]) middle();
    placeCut();
    frame();
    moment = 0;
    names.forEach(fill);
    timeline();
    const said = {
      sample: sample.name,
      ...(sample.sensor && {
        position: sample.position.map((value) => value.toFixed(2)).join(", ") + " m",
        heading: `${(heading() * 180 / Math.PI).toFixed(1)}°`,
      }),
      grid: `${sample.shape.join(" × ")} of ${sample.voxel} m`,
      ...sample.figures,
    };
    find("figures").replaceChildren(...Object.entries(said).map(([name, value]) => {
      const row = make("tr");
      row.append(make("td", name), make("td", value));
      return row;
    }));
    legend();
    if (first) view(false);
    now();
    drop("#picked");
    find("picked").textContent = "";
    const from = told.get("camera")?.split("~").map(Number);
    if (from?.length === 6 && from.every(Number.isFinite)) {
      camera.position.fromArray(from);
      controls.target.fromArray(from, 3);
      controls.update();
    }
    told.delete("camera"); // once
    if (live && on !== number && on >= 0 && on < count()) fetched(on);
    document.body.dataset.sample = current;
    document.body.dataset.milliseconds = Math.round(performance.now() - began);
  }

  function legend() {
    const bar = (title, anchors, low, high) => {
      const strip = Object.assign(make("div"), { className: "bar" }), ends = Object.assign(make("div"), { className: "ends" });
      strip.style.background = css(anchors);
      ends.append(make("span", low), make("span", title), make("span", high));
      return [strip, ends];
    };
    const low = sample.origin[2], high = low + sample.shape[2] * sample.voxel, metres = (value) => `${(Math.round(value * 10) / 10 || 0).toFixed(1)} m`;
    const parts = [
      ...bar("height", data.colours.heights, metres(low), metres(high)),
      ...bar("distance", data.colours.distances, "0 m", `${sample.truncation} m`),
    ];
    if (names.some((name) => kinds.get(name) === "doubt" && layers[name]) && Object.keys(fields.chance).length) {
      parts.push(...bar("doubt: as opaque as probable", [[...ground, 0.1], [...data.colours.heights[5], 1]], "10 %", "100 %"));
    }
    const entry = (colour, words) => {
      const line = make("label"), swatch = make("i");
      swatch.style.background = `rgb(${colour})`;
      line.append(swatch, make("span", words));
      parts.push(line);
    };
    if (layers.classes) for (const [name, count] of [...fields.classes.counts].sort((one, other) => other[1] - one[1])) {
      entry(classColour(name), `${name}, ${count} voxels`);
    }
    if (layers.movers) {
      const kind = (name) => fields.movers.filter((mover) => mover.kind === name).length, all = [...new Set(fields.movers.map((mover) => mover.kind))];
      entry(PLAIN.movers, `movers of the world: ${all.map((name) => `${name} × ${kind(name)}`).join(", ") || "none"}`);
    }
    if (layers.ghosts) entry(PLAIN.ghosts, "ghosts: observed voxels where nothing is at the sample's time");
    if (names.some((name) => /missed|invented/.test(kinds.get(name)) && layers[name])) {
      parts.push(make("div", "Errors that touch a voxel that is right are counted, but not drawn."));
    }
    find("legend").replaceChildren(...parts);
  }

  function middle() {
    const count = sample.shape[+find("axis").value];
    find("level").max = count - 1;
    find("level").value = Math.max(Math.floor(count / 2) - 1, 0);
  }

  function step(levels) {
    if (!sample) return;
    find("level").value = +find("level").value + levels;
    const slices = names.filter((name) => kinds.get(name) === "distances" && wanted(name));
    slices.forEach(fill);
    if (!slices.length) boxes[names.indexOf("distances")].click();
  }

  data.samples.forEach((one, n) => find("which").append(Object.assign(make("option", one.name), { value: n })));
  find("time").max = data.samples.length - 1;
  find("which").hidden = !!data.film;
  find("time").hidden = !data.film;
  which[data.film ? "oninput" : "onchange"] = () => show(Math.round(+which.value) || 0);
  if (live) {
    find("which").hidden = true;
    find("split").hidden = find("number").hidden = false;
    const offer = (split) => {
      const options = Object.entries(splits()).map(([name, most]) => Object.assign(make("option", `${name}: ${most}`), { value: name }));
      find("split").replaceChildren(...options);
      if (split in splits()) find("split").value = split;
    };
    live.datasets.forEach(({ name }, n) => find("dataset").append(Object.assign(make("option", name), { value: n })));
    find("dataset-row").hidden = live.datasets.length < 2;
    find("title").hidden = live.datasets.length > 1;
    if (told.get("dataset") in live.datasets) find("dataset").value = told.get("dataset");
    find("dataset").onchange = () => { offer(find("split").value); show(0); };
    find("split").onchange = () => show(0);
    offer(told.get("split") ?? live.split);
  }
  // Samples follow one another, five a second where the browser can, as a flight's moments do.
  // Where a sample has movers, their time plays, over and over; a film ends with it.
  let playing = false, filming = false;
  async function run() {
    const { scans, end } = sample.movers, of = fields;
    if (moment >= end) at(Math.min(...scans));
    for (let before = performance.now(); playing && of === fields;) {
      await new Promise(requestAnimationFrame);
      const now = performance.now(), next = moment + (now - before) / 1000;
      before = now;
      if (of !== fields) break; // another sample was asked for meanwhile
      at(next > end && !filming ? Math.min(...scans) : next);
      if (next > end && filming) break;
    }
  }
  async function play() {
    find("film").disabled = playing = !playing;
    find("play").textContent = playing ? "❚❚" : "▶▶";
    if (playing && fields.movers) {
      await run();
      if (playing) await play();
      return;
    }
    if (playing && current >= count() - 1) await show(0);
    while (playing && current < count() - 1) {
      const due = performance.now() + 200, at = current;
      await show(current + 1);
      if (current === at) break; // another sample was asked for meanwhile
      await new Promise((done) => setTimeout(done, Math.max(due - performance.now(), 20)));
    }
    if (playing) await play();
  }
  find("play").onclick = play;

  // A film has its robot followed; a flight's has curves, in which one sees and chooses the time.
  find("follow-row").hidden = !data.film;
  find("camera").onchange = () => { find("camera").value === "free" ? view(false) : now(); };
  const cursors = [];
  function now() {
    if (!data.film || !sample) return;
    const how = find("camera").value;
    if (how !== "free") follow(fields.sensor, heading(), how, 4, playing ? 200 : 1);
    if (film) cursors.forEach((at) => at(film.times[current]));
  }
  function curve(name, values) {
    const svg = (tag, names) => {
      const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
      Object.entries(names).forEach(([key, value]) => made.setAttribute(key, value));
      return made;
    };
    const end = film.at.at(-1) || 1, top = Math.max(...values) || 1, [title, unit] = name.split(", ");
    const box = svg("svg", { viewBox: "0 0 1000 100", preserveAspectRatio: "none", class: "curve", role: "img", "aria-label": name });
    const spots = film.at.map((time, n) => `${(1000 * time / end).toFixed(1)},${(97 - 92 * values[n] / top).toFixed(1)}`);
    const cursor = svg("line", { y1: 0, y2: 100, class: "cursor" });
    box.append(svg("polyline", { points: spots.join(" ") }), cursor);
    if (film.ends[film.flight].hit) box.append(svg("line", { x1: 999, x2: 999, y1: 0, y2: 100, class: "hit" }));
    const words = Object.assign(make("div"), { className: "ends" }), read = make("span");
    words.append(make("span", `${title}, 0 to ${top.toFixed(2)} ${unit}`), read);
    const at = (time) => {
      const near = film.at.reduce((best, one, n) => (Math.abs(one - time) < Math.abs(film.at[best] - time) ? n : best), 0);
      read.textContent = `${values[near].toFixed(2)} ${unit} at ${film.at[near].toFixed(1)} s`;
      cursor.setAttribute("x1", 1000 * time / end);
      cursor.setAttribute("x2", 1000 * time / end);
    };
    cursors.push(at);
    const timeAt = (event) => end * (event.clientX - box.getBoundingClientRect().left) / box.getBoundingClientRect().width;
    box.onpointermove = (event) => cursors.forEach((one) => one(timeAt(event)));
    box.onpointerleave = () => cursors.forEach((one) => one(film.times[current]));
    box.onclick = (event) => show(film.times.reduce((best, one, n) => (Math.abs(one - timeAt(event)) < Math.abs(film.times[best] - timeAt(event)) ? n : best), 0));
    find("curves").append(words, box);
  }
  if (film) {
    film.times = data.samples.map((one) => parseFloat(one.name));
    film.at = Object.values(film.curves)[0].map((_, n) => Math.min(n * film.period_s, film.time_s));
    Object.entries(film.curves).forEach(([name, values]) => curve(name, values));
    const others = film.ends.filter((_, n) => n !== film.flight), list = make("details");
    find("curves").append(Object.assign(make("p", film.ends[film.flight].text), { id: "outcome" }));
    list.append(make("summary", `${others.length} other flights through this world, ${others.filter((one) => one.hit).length} with a hit`));
    for (const { text, hit } of others) {
      const line = Object.assign(make("div", text), { className: "flight" });
      if (hit) line.onclick = () => { controls.target.set(...hit.map((value, n) => value - sample.origin[n])); controls.update(); };
      list.append(line);
    }
    if (others.length) find("curves").append(list);
  }
  find("before").onclick = () => show(current - 1);
  find("next").onclick = () => show(current + 1);
  find("axis").onchange = () => { middle(); step(0); };
  find("level").oninput = () => step(0);
  const keys = {
    ArrowLeft: () => show(current - 1), ArrowRight: () => show(current + 1),
    " ": play, Home: () => show(0), End: () => show(count() - 1),
    ArrowUp: () => step(1), ArrowDown: () => step(-1), v: () => beside((views() % 3) + 1), r: () => view(false), t: () => view(true),
  };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, #number")) return;
    if (event.key === " " && event.target.matches("button, input:not([type=range])")) return; // which it presses
    if (event.target.matches("input[type=range]") && event.key.length > 1) return; // arrows are the slider's own
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (act) act();
    else if (/^[1-9]$/.test(event.key)) boxes[event.key - 1]?.click();
    else return;
    event.preventDefault();
  });
  function resize() {
    const { clientWidth: width, clientHeight: height } = canvas;
    camera.aspect = width / views() / Math.max(height, 1);
    // A narrow view is as wide as any, and higher: so the same camera shows the same in all of them.
    const high = Math.tan(Math.PI / 8) * Math.max(1, 1.2 / camera.aspect);
    camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(high));
    camera.updateProjectionMatrix();
    renderer?.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer?.setSize(width, height, false);
    renderer?.setScissorTest(true);
    draw();
  }
  new ResizeObserver(resize).observe(canvas);
  const chosen = (told.get("views") ?? "").split("~").filter((name) => sets.has(name));
  split(chosen.length > 1 ? chosen.slice(0, 3) : []);
  await show(Math.floor(+(told.get("sample") ?? (live ? live.index : 0))) || 0);
})().catch((error) => {
  if (parent === window) throw error;
  document.body.hidden = true; // a notebook has a picture behind this frame
});
