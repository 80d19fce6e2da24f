"use strict";
// What all pages share: the renderer, a camera that one turns, and means to build the panel.
async function makeStage(quality) {
  const find = (id) => document.getElementById(id);
  const data = JSON.parse(find("data").textContent);
  const make = (tag, text) => Object.assign(document.createElement(tag), { textContent: text ?? "" });
  const note = (text) => find("notes").append(Object.assign(make("div", text), { className: "note" }));
  find("title").textContent = data.title;
  data.notes.forEach(note);

  async function unpack(text) {
    const packed = Uint8Array.from(atob(text), (char) => char.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // The renderer's files are modules, one of which imports the other. They become scripts of this
  // page itself: a notebook's frame may load no others.
  const renames = (names, between) => names.split(",").filter((one) => one.trim()).map((one) => {
    const [from, to] = one.trim().split(/\s+as\s+/);
    return between(from, to ?? from);
  }).join(", ");
  for (const name of ["three", "orbit"]) {
    const code = new TextDecoder().decode(await unpack(find(name).textContent))
      .replace(/\bimport\s*\{([^}]*)\}\s*from\s*["']three["']/, (_, names) => `const { ${renames(names, (from, to) => `${from}: ${to}`)} } = window.three`)
      .replace(/\bexport\s*\{([^}]*)\}/, (_, names) => `window.${name} = { ${renames(names, (from, to) => `${to}: ${from}`)} }`);
    const script = make("script", `(() => { "use strict"; ${code}\n})()`);
    script.nonce = find("main").nonce;
    document.head.append(script);
  }
  const THREE = window.three, { OrbitControls } = window.orbit;

  const canvas = find("scene");
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true, ...quality });
  } catch {
    note("This browser shows no WebGL, which the picture needs; names and statistics are shown all the same.");
  }
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const [ground, ink] = dark ? [[38, 43, 50], "#e6e9ed"] : [[255, 255, 255], "#1b1f24"];
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(`rgb(${ground})`);
  scene.add(new THREE.HemisphereLight(0xffffff, 0x9aa4b0, 2.4));
  const sun = new THREE.DirectionalLight(0xffffff, 1.6);
  sun.position.set(-1, -2, 4);
  scene.add(sun);
  const camera = new THREE.PerspectiveCamera(45, 1, 0.05, 5000);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, canvas);
  const rgb = (value) => new THREE.Color().setRGB(value[0] / 255, value[1] / 255, value[2] / 255, THREE.SRGBColorSpace);
  const css = (anchors) => `linear-gradient(90deg, ${anchors.map((one) => `rgb(${one})`).join(", ")})`;
  function ramp(anchors, share) {
    const at = Math.min(Math.max(share, 0), 1) * (anchors.length - 1);
    const low = Math.min(Math.floor(at), anchors.length - 2);
    return [0, 1, 2].map((n) => anchors[low][n] + (at - low) * (anchors[low + 1][n] - anchors[low][n]));
  }

  const surface = (corners, colour) => {
    const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(corners, 3));
    shape.computeVertexNormals();
    const colours = new Float32Array(corners.length);
    for (let n = 0; n < corners.length; n += 3) colour(corners[n + 2]).toArray(colours, n);
    return shape.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  };

  function ball(place, radius, colour) {
    const made = new THREE.Mesh(new THREE.SphereGeometry(radius, 24, 16), new THREE.MeshLambertMaterial({ color: rgb(colour) }));
    made.position.set(...place);
    return made;
  }

  // A sensor: its place, a cone that points forward, and the edges of what it sees, `long` metres.
  // fov: first and last azimuth, least and greatest elevation, degrees; null where it is not known.
  function sensorAt(place, [w, x, y, z], fov, long) {
    const all = new THREE.Group(), nose = new THREE.ConeGeometry(0.05 * long, 0.3 * long, 16).rotateZ(-Math.PI / 2).translate(0.2 * long, 0, 0);
    all.add(ball([0, 0, 0], 0.08 * long, data.colours.sensor), new THREE.Mesh(nose, new THREE.MeshLambertMaterial({ color: rgb(data.colours.sensor) })));
    const ends = [0, 0, 0, 0, 0, 0.4 * long]; // upwards
    if (fov) {
      const [from, to, low, high] = fov.map((one) => one * Math.PI / 180), steps = 48, round = to - from > 6;
      const way = (azimuth, height) => [Math.cos(height) * Math.cos(azimuth), Math.cos(height) * Math.sin(azimuth), Math.sin(height)].map((one) => one * long);
      for (const height of [low, high]) for (let n = 0; n <= steps; n++) {
        const azimuth = from + ((to - from) * n) / steps;
        if (n < steps) ends.push(...way(azimuth, height), ...way(azimuth + (to - from) / steps, height));
        if (n % (round ? steps / 8 : steps) === 0) ends.push(0, 0, 0, ...way(azimuth, height));
      }
    }
    const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(ends, 3));
    all.add(new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: rgb(data.colours.sensor), transparent: true, opacity: 0.55 })));
    all.position.set(...place);
    all.quaternion.set(x, y, z, w);
    return all;
  }

  // The camera goes behind what moves, or above it, in the time from one picture to the next.
  let moving = 0;
  function follow(place, heading, how, far, time) {
    const mine = ++moving, [x, y, z] = place, ahead = [Math.cos(heading), Math.sin(heading)];
    const [eye, target] = how === "above"
      ? [[x, y - 0.001 * far, z + 2.2 * far], place]
      : [[x - ahead[0] * far, y - ahead[1] * far, z + 0.45 * far], [x + ahead[0] * 0.6 * far, y + ahead[1] * 0.6 * far, z]];
    const begin = performance.now(), from = [camera.position.clone(), controls.target.clone()];
    const ends = [new THREE.Vector3(...eye), new THREE.Vector3(...target)];
    const step = () => {
      if (mine !== moving) return;
      const share = Math.min((performance.now() - begin) / time, 1);
      camera.position.lerpVectors(from[0], ends[0], share);
      controls.target.lerpVectors(from[1], ends[1], share);
      controls.update();
      if (share < 1) requestAnimationFrame(step);
    };
    step();
  }
  controls.addEventListener("start", () => { // a hand turns it: nothing follows any more
    moving++;
    find("camera").value = "free";
  });

  return { THREE, data, find, make, note, unpack, canvas, renderer, scene, camera, controls, dark, ground, ink, rgb, css, ramp, surface, ball, sensorAt, follow };
}
