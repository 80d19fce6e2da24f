"use strict";
(async () => {
  const { THREE, data, find, make, note, canvas, renderer, scene, camera, controls, rgb, css, surface, sensorAt, follow } = await makeStage({ antialias: false, preserveDrawingBuffer: false });
  const { fov } = data.stream;
  if (!renderer) return;
  document.body.dataset.frames = 0;
  const panel = find("panel"), shown = ["title", "follow-row", "legend", "figures", "notes"];
  for (const part of [...panel.children]) if (!shown.includes(part.id)) part.hidden = true;
  find("follow-row").hidden = false;
  const solids = Object.assign(make("input"), { type: "checkbox", checked: true, id: "solids" });
  const label = make("label");
  label.append(solids, make("span", "solids"));
  find("follow-row").after(label);
  find("camera").onchange = () => { placed = false; };

  // Points come as 16-bit numbers around the first sensor, and stay so: the shader scales and colours
  // them by their height, so that a scan costs the page no loop over its points.
  const tints = data.colours.heights.map((one) => rgb(one)), span = { value: new THREE.Vector2(0, 1) };
  const gl = renderer.getContext(), info = gl.getExtension("WEBGL_debug_renderer_info");
  const slow = info && /swiftshader|llvmpipe/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)); // no graphics card
  const material = new THREE.PointsMaterial({ size: slow ? 1 : 2, sizeAttenuation: false, transparent: true }); // drawn after the solids, which would veil them
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, { span, tints: { value: tints } });
    const count = tints.length;
    shader.vertexShader = shader.vertexShader.replace("void main() {", `uniform vec2 span; uniform vec3 tints[${count}]; varying vec3 vTint;
      void main() {
      float share = clamp(((modelMatrix * vec4(position, 1.0)).z - span.x) / (span.y - span.x), 0.0, 1.0) * ${count - 1}.0;
      vTint = mix(tints[int(share)], tints[min(int(share) + 1, ${count - 1})], fract(share));`);
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", "varying vec3 vTint;\nvoid main() {")
      .replace("#include <color_fragment>", "#include <color_fragment>\ndiffuseColor.rgb = vTint;");
  };
  const cloud = new THREE.Points(new THREE.BufferGeometry(), material);
  cloud.frustumCulled = false;
  cloud.renderOrder = 1;
  const sensors = new THREE.Group(), bodies = new THREE.Group(), MAX_TRAIL = 2000;
  let trail = 0;
  const line = new THREE.Line(new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * MAX_TRAIL), 3)), new THREE.LineBasicMaterial({ color: rgb(data.colours.sensor) }));
  line.frustumCulled = false;
  scene.add(cloud, sensors, bodies, line);
  solids.onchange = () => {
    bodies.visible = solids.checked;
    turned = true;
  };

  // The solids as they were at the first scan; each then moves with its geom.
  const began = new Map();
  async function loadSolids() {
    const { geoms, sizes, places, triangles } = await (await fetch("solids")).json();
    const packed = Uint8Array.from(atob(triangles), (char) => char.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const corners = new Float32Array(await new Response(stream).arrayBuffer());
    const grey = rgb([150, 156, 164]);
    let first = 0;
    geoms.forEach((geom, place) => {
      const count = sizes[place];
      // lit once, here: light at every pixel costs a software renderer most of its time
      const shape = surface(corners.slice(first, first + count), () => grey), { normal, color } = shape.attributes;
      for (let n = 0; n < count / 3; n++) {
        const share = 0.75 + 0.12 * normal.getX(n) - 0.08 * normal.getY(n) + 0.25 * normal.getZ(n);
        color.setXYZ(n, share * color.getX(n), share * color.getY(n), share * color.getZ(n));
      }
      first += count;
      const mesh = new THREE.Mesh(shape, new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.6, depthWrite: false }));
      mesh.matrixAutoUpdate = false;
      began.set(mesh, matrixOf(places[geom]).invert());
      bodies.add(Object.assign(mesh, { userData: { geom } }));
    });
    turned = true;
  }
  const matrixOf = (row) => new THREE.Matrix4().set(row[3], row[4], row[5], row[0], row[6], row[7], row[8], row[1], row[9], row[10], row[11], row[2], 0, 0, 0, 1);
  function moveSolids(places) {
    for (const mesh of bodies.children) {
      const { geom } = mesh.userData;
      mesh.matrix.multiplyMatrices(matrixOf(places.subarray(12 * geom, 12 * geom + 12)), began.get(mesh));
    }
  }

  // A machine that draws fewer than 10 scans a second of those that come draws every second point, or fewer.
  let placed = false, capacity = 0, step = 1;
  const drawnAt = [];
  function take(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const end = buffer.byteLength - 8 * head.points; // of the places of geoms
    const places = new Float32Array(buffer, 4 + length, (end - 4 - length) / 4);
    const points = new Int16Array(buffer, end, 4 * head.points);
    if (head.points > capacity) { // buffers grow, and are used again
      capacity = Math.ceil(1.2 * head.points);
      cloud.geometry.dispose();
      cloud.geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(new Int16Array(4 * capacity), 4, true).setUsage(THREE.DynamicDrawUsage));
    }
    const attribute = cloud.geometry.attributes.position;
    if (attribute) {
      const drawn = Math.ceil(head.points / step);
      if (step === 1) attribute.array.set(points);
      else for (let n = 0; n < drawn; n++) for (let axis = 0; axis < 4; axis++) attribute.array[4 * n + axis] = points[4 * step * n + axis];
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, 4 * drawn);
      attribute.needsUpdate = true;
      cloud.geometry.setDrawRange(0, drawn);
    }
    const [first] = head.sensors, place = first.slice(0, 3);
    cloud.position.set(...place);
    cloud.scale.setScalar(head.reach);
    span.value.set(...head.heights);
    moveSolids(places);
    // made once: without its last user, a shader is compiled anew
    if (sensors.children.length !== head.sensors.length) {
      sensors.clear();
      for (const one of head.sensors) sensors.add(sensorAt(one.slice(0, 3), one.slice(3), fov, Math.min(Math.max(0.05 * head.reach, 0.5), 3)));
    }
    head.sensors.forEach(([px, py, pz, qw, qx, qy, qz], n) => {
      sensors.children[n].position.set(px, py, pz);
      sensors.children[n].quaternion.set(qx, qy, qz, qw);
    });
    if (trail === MAX_TRAIL) { // the older half is forgotten
      line.geometry.attributes.position.array.copyWithin(0, 1.5 * MAX_TRAIL);
      trail = MAX_TRAIL / 2;
    }
    line.geometry.attributes.position.array.set(place, 3 * trail++);
    line.geometry.attributes.position.needsUpdate = true;
    line.geometry.setDrawRange(0, trail);
    const [w, x, y, z] = first.slice(3), heading = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    const how = find("camera").value, far = Math.min(Math.max(0.4 * head.reach, 3), 12);
    if (how !== "free") follow(place, heading, how, far, slow ? 1 : 80);
    else if (!placed) {
      camera.position.set(place[0] - 0.8 * head.reach, place[1] - 1.2 * head.reach, place[2] + 0.9 * head.reach);
      controls.target.set(...place);
      controls.update();
    }
    placed = true;
    return head;
  }

  let head = null, fresh = false, turned = true, told = { number: 0, at: 0, again: 0 };
  controls.addEventListener("change", () => { turned = true; });
  function frame() {
    requestAnimationFrame(frame);
    if (head && told.number !== head.number && performance.now() > told.again) tell();
    if (!fresh && !turned) return;
    turned = false;
    renderer.render(scene, camera);
    if (!fresh) return;
    fresh = false;
    drawnAt.push(performance.now());
    while (drawnAt[0] < performance.now() - 2000) drawnAt.shift();
    document.body.dataset.frames = +document.body.dataset.frames + 1;
    document.body.dataset.points = head.points;
  }
  // A panel that changes with every picture would cost a slow machine as much as the points.
  function tell() {
    const came = 1000 * (head.number - told.number) / (performance.now() - told.at);
    told = { number: head.number, at: performance.now(), again: performance.now() + 250 };
    const rate = drawnAt.length > 1 ? (1000 * (drawnAt.length - 1)) / (drawnAt.at(-1) - drawnAt[0]) : 0;
    if (drawnAt.length > 8 && rate < 10 && came > 1.2 * rate && step < 8) {
      step += 1;
      drawnAt.length = 0; // the new rate is of the new points alone
    }
    const rows = {
      time: `${head.time.toFixed(2)} s`, scan: head.number, returns: step === 1 ? head.points : `${head.points}, one in ${step} is drawn`, "drawn a second": rate.toFixed(1),
      position: head.sensors[0].slice(0, 3).map((one) => one.toFixed(2)).join(", ") + " m",
    };
    find("figures").replaceChildren(...Object.entries(rows).map(([name, value]) => {
      const row = make("tr");
      row.append(make("td", name), make("td", value));
      return row;
    }));
    if (find("legend").dataset.ends !== `${head.heights}`) {
      const strip = Object.assign(make("div"), { className: "bar" }), ends = Object.assign(make("div"), { className: "ends" });
      strip.style.background = css(data.colours.heights);
      ends.append(...[`${head.heights[0].toFixed(1)} m`, "height", `${head.heights[1].toFixed(1)} m`].map((text) => make("span", text)));
      find("legend").replaceChildren(strip, ends);
      find("legend").dataset.ends = head.heights;
    }
  }
  function resize() {
    const { clientWidth: width, clientHeight: height } = canvas;
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    turned = true;
  }
  new ResizeObserver(resize).observe(canvas);
  resize();
  requestAnimationFrame(frame);

  // Always the newest scan: the server skips those that came meanwhile, and answers when there is one.
  let number = 0, loaded = false;
  for (;;) {
    const buffer = await fetch(`scan/${number}`).then((answer) => answer.arrayBuffer()).catch(() => null);
    find("notes").replaceChildren();
    if (buffer === null) {
      note("The simulation has ended, or does not answer; the last scan is shown.");
      [number, loaded] = [0, false];
      await new Promise((done) => setTimeout(done, 1000));
    } else if (buffer.byteLength) { // else none came for a while
      head = take(buffer);
      [number, fresh] = [head.number, true];
      if (!loaded) {
        loaded = true;
        bodies.clear();
        began.clear();
        loadSolids().catch(() => note("The solids of the world are not shown."));
      }
    }
  }
})();
