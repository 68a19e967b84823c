// What all pages share: the water that is looked into, a camera, instruments, and frames in time.

const byId = (id) => document.getElementById(id);
const status = document.documentElement.dataset; // what a test may read: time, playing, frames

function fail(message) {
  byId("message").textContent = message;
  byId("message").hidden = false;
  status.error = message;
}

// The largest of 1, 2, 5 times a power of ten up to x.
function roundNumber(x) {
  const power = 10 ** Math.floor(Math.log10(x)), digit = x / power;
  return Number(((digit >= 5 ? 5 : digit >= 2 ? 2 : 1) * power).toPrecision(1)); // 0.2, not 0.2000…1
}

function digits(x) {
  return String(Number(x.toPrecision(2)));
}

// Seen so that what swims along the heading swims to the right, a little towards the viewer.
const VIEWS = {
  swim: { azimuth: -72, elevation: 11 },
  side: { azimuth: -90, elevation: 0 },
  top: { azimuth: -90, elevation: 89.5 },
  front: { azimuth: 12, elevation: 8 },
  below: { azimuth: -60, elevation: -28 },
};

// Water of a world (`surface`, `waves`, `bed`) around robots of a size [m]; null without WebGL.
function openStage(world, size) {
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: byId("view"), antialias: true });
  } catch {
    fail("This page draws with WebGL 2, which this browser does not offer or has switched off.");
    return null;
  }
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    const log = [vertex, fragment].map((shader) => gl.getShaderInfoLog(shader)).join(" ").trim();
    fail(`A shader did not compile: ${log}`);
    console.error(log);
  };

  maxWaves = Math.max(1, world.waves.length);
  shared.uWaves.value = Array.from({ length: maxWaves }, () => new THREE.Vector4());
  shared.uFade.value = world.waves.length ? world.waves.map((wave) => wave.k) : [0];
  shared.uSurface.value = world.surface;
  shared.uSize.value = size;

  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(38, 1, 0.02 * size, 3000);
  camera.up.set(0, 0, 1);
  const background = makeBackground(), surface = makeSurface(size);
  const dust = makeDust(size), shadow = makeShadow(size);
  scene.add(background.mesh, surface.mesh, dust.points);
  if (world.bed !== null) scene.add(makeBed(world.bed));

  // ------------------------------------------------------------------ the camera

  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  controls.enableDamping = true;
  controls.dampingFactor = 0.12;
  controls.minDistance = 0.3 * size;
  controls.maxDistance = 60 * size;
  controls.zoomSpeed = 0.8;
  const target = controls.target, here = new THREE.Vector3(), before = new THREE.Vector3();
  let dirty = true, frames = 0;
  const draw = () => (dirty = true);
  controls.addEventListener("change", draw);

  // Looks at the target from a side; azimuth is from the heading on, angles are in degrees.
  function look({ azimuth, elevation, distance = 1 }, heading) {
    const narrow = Math.min(1, camera.aspect), reach = (distance * 0.86 * size) / Math.tan((camera.fov * Math.PI) / 360) / narrow;
    const a = ((heading + azimuth) * Math.PI) / 180;
    let e = (elevation * Math.PI) / 180;
    // A camera in the surface sees neither side of it well.
    const above = (x) => target.z + reach * Math.sin(x) - world.surface;
    if (Math.abs(elevation) < 60 && above(e) > -0.25 * size && above(e) < 0.45 * size) {
      e = Math.asin(Math.min(0.8, (world.surface + 0.45 * size - target.z) / reach));
    }
    camera.position.set(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    camera.position.multiplyScalar(reach).add(target);
    controls.update();
    draw();
  }

  function zoom(by) {
    const arm = camera.position.clone().sub(target).multiplyScalar(by);
    arm.setLength(Math.min(Math.max(arm.length(), controls.minDistance), controls.maxDistance));
    camera.position.copy(target).add(arm);
    draw();
  }

  const bedTable = world.bed && {
    ...world.bed, radius: numbersOf(world.bed.radius), height: numbersOf(world.bed.height),
  };

  function bedAt(x, y) {
    if (world.bed === null) return -Infinity;
    const { center: c, radius, height, sectors, rings } = bedTable;
    const r = Math.hypot(x - c[0], y - c[1]), angle = Math.atan2(y - c[1], x - c[0]) / (2 * Math.PI);
    let i = 0;
    while (i + 2 < rings && radius[i + 1] < r) i++;
    const s = Math.min(Math.max((r - radius[i]) / (radius[i + 1] - radius[i]), 0), 1);
    const j = (((angle % 1) + 1) % 1) * sectors, j0 = Math.floor(j), t = j - j0;
    const at = (a, b) => height[a * sectors + (b % sectors)];
    const ring = (a) => at(a, j0) * (1 - t) + at(a, j0 + 1) * t;
    return ring(i) * (1 - s) + ring(i + 1) * s;
  }

  function pixelsPerMetre() {
    const far = camera.position.distanceTo(target);
    return renderer.domElement.clientHeight / (2 * far * Math.tan((camera.fov * Math.PI) / 360));
  }

  // ------------------------------------------------------------------ switches and keys

  // Buttons that are pressed or not, by id: what each shows.
  function switches(shown) {
    const toggle = (name, on) => {
      const button = byId(name);
      if (button.disabled) return;
      const next = on ?? button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(next));
      shown[name](next);
      draw();
    };
    for (const name in shown) {
      const button = byId(name);
      button.addEventListener("click", () => toggle(name));
      shown[name](button.getAttribute("aria-pressed") === "true");
    }
    return toggle;
  }

  // What keys do, by name; letters by their small ones.
  function listen(keys) {
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.target instanceof HTMLElement && event.target.matches("input:not([type=range])")) return;
      if ([" ", "Enter"].includes(event.key) && event.target instanceof HTMLButtonElement) return; // presses it
      const action = keys[event.key] ?? keys[event.key.toLowerCase()];
      if (!action) return;
      action(event);
      event.preventDefault();
    });
  }

  // ------------------------------------------------------------------ instruments

  // A 2D canvas as sharp as the screen.
  function pen(id) {
    const canvas = byId(id), ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = canvas;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, w, h);
    context.font = "11px system-ui, sans-serif";
    return { context, w, h };
  }

  function drawAxes() {
    const { context: c, w, h } = pen("axes"), arm = 0.32 * w;
    const along = ["x", "y", "z"].map((name, k) => {
      const d = new THREE.Vector3().setComponent(k, 1).applyQuaternion(camera.quaternion.clone().invert());
      return { name, d, color: ["#ff7b6b", "#8fe388", "#7cc4ff"][k] };
    });
    along.sort((a, b) => a.d.z - b.d.z);
    c.lineWidth = 2;
    c.textAlign = "center";
    c.textBaseline = "middle";
    for (const { name, d, color } of along) {
      c.strokeStyle = c.fillStyle = color;
      c.beginPath();
      c.moveTo(w / 2, h / 2);
      c.lineTo(w / 2 + arm * d.x, h / 2 - arm * d.y);
      c.stroke();
      c.fillText(name, w / 2 + (arm + 8) * d.x, h / 2 - (arm + 8) * d.y);
    }
  }

  // Depths below the surface, down to the bed or to the deepest; the floor is that below a place.
  function drawGauge(depth, deepest, floor) {
    const { context: c, w, h } = pen("gauge"), top = 27, bottom = h - 10, x = 40;
    const tick = roundNumber(deepest / 3.2);
    const y = (d) => top + ((bottom - top) * Math.min(Math.max(d, -0.05 * deepest), deepest)) / deepest;
    const water = c.createLinearGradient(0, top, 0, bottom);
    water.addColorStop(0, "rgba(120, 220, 230, 0.85)");
    water.addColorStop(1, "rgba(10, 50, 90, 0.85)");
    c.fillStyle = water;
    c.fillRect(x, top, 7, bottom - top);
    c.fillStyle = c.strokeStyle = "rgba(235, 250, 252, 0.85)";
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (let d = 0; d <= deepest * 1.001; d += tick) {
      c.fillRect(x - 4, y(d) - 0.5, 4, 1);
      c.fillText(`${digits(d)}`, x - 7, y(d));
    }
    c.textAlign = "left";
    c.fillText("depth [m]", 4, 7);
    if (floor < deepest) {
      c.fillStyle = "#c9b07a";
      c.fillRect(x - 1, y(floor), 9, bottom - y(floor) + 3);
      if (y(floor) - y(depth) > 13) c.fillText("bed", x + 13, Math.min(y(floor) + 5, h - 6));
    }
    c.fillStyle = "#ff8c3c";
    c.beginPath();
    c.moveTo(x + 8, y(depth));
    c.lineTo(x + 17, y(depth) - 6);
    c.lineTo(x + 17, y(depth) + 6);
    c.fill();
    c.fillText(depth.toFixed(2), x + 20, y(depth));
  }

  function write(id, text) {
    const place = byId(id);
    if (place.textContent !== text) place.textContent = text;
  }

  // ------------------------------------------------------------------ frames

  let pixelRatio = Math.min(devicePixelRatio || 1, 2);

  function resize() {
    renderer.setPixelRatio(pixelRatio);
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
    dust.material.uniforms.uPixels.value = (innerHeight * pixelRatio) / (2 * Math.tan((camera.fov * Math.PI) / 360));
    stage.resized?.();
    draw();
  }
  addEventListener("resize", resize);

  // Water at a time of the world [s], camera and light for what is looked at; follow: it goes along.
  function place(time, at, follow) {
    shared.uTime.value = time;
    world.waves.forEach((wave, k) => {
      const phase = wave.phase - wave.omega * time;
      shared.uWaves.value[k].set(wave.k * wave.x, wave.k * wave.y, wave.amplitude, phase % (2 * Math.PI));
    });
    here.copy(at);
    if (follow) {
      before.copy(target);
      target.copy(here);
      camera.position.add(before.subVectors(target, before));
    }
    controls.update();
    const ground = bedAt(camera.position.x, camera.position.y) + 0.06 * size;
    if (camera.position.z < ground) {
      camera.position.z = ground;
      camera.lookAt(target);
    }
    camera.updateMatrixWorld();
    shared.uEye.value.copy(camera.position);
    shared.uTarget.value.copy(here);
    background.update(camera);
    surface.update(here, camera.position);
  }

  let lastTick = performance.now(), slow = 0;

  // Draws for ever: `moves(seconds)` says whether time goes on, `update` places what is seen, `told`
  // writes what instruments show.
  function run({ moves, update, told }) {
    function tickFrame(now) {
      requestAnimationFrame(tickFrame);
      // The first tick may lie before the script's own time, and a hidden page has none for long.
      const passed = Math.min(Math.max((now - lastTick) / 1000, 0), 0.25);
      lastTick = now;
      if (moves(passed)) {
        dirty = true;
        // A slow machine gets plain panels, then fewer pixels, rather than fewer frames.
        slow = passed > 0.05 ? slow + (passed > 0.12 ? 4 : 1) : Math.max(0, slow - 1);
        if (slow > 12 && !document.body.classList.contains("plain")) {
          document.body.classList.add("plain");
          slow = 0;
        } else if (slow > 12 && pixelRatio > 0.5) {
          pixelRatio = Math.max(0.5, pixelRatio * 0.75);
          slow = 0;
          resize();
        }
      }
      if (controls.update()) dirty = true;
      if (!dirty) return;
      dirty = false;
      update();
      shadow.render(renderer, scene, here, stage.bent);
      renderer.clear();
      renderer.render(scene, camera);
      told();
      status.frames = ++frames;
    }
    requestAnimationFrame(tickFrame);
  }

  const stage = {
    renderer, scene, camera, controls, target, here, surface, dust, shadow, resized: null, bent: [],
    draw, look, zoom, bedAt, pixelsPerMetre, switches, listen, pen, drawAxes, drawGauge, write,
    resize, place, run,
  };
  return stage;
}
