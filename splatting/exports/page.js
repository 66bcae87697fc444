// The gzip file that an element holds in base64, unpacked. In pieces, so that no second copy of a large model is made.
const unpacked = (id) => {
  const element = document.getElementById(id), text = element.textContent, step = 1 << 20;
  element.remove();
  let next = 0;
  const packed = new ReadableStream({
    pull(stream) {
      if (next >= text.length) return stream.close();
      stream.enqueue(Uint8Array.from(atob(text.slice(next, next += step)), (letter) => letter.charCodeAt(0)));
    },
  });
  return new Response(packed.pipeThrough(new DecompressionStream('gzip')));
};

// The viewer takes opening angles across the longer side of the window; the settings have vertical ones. A photo of
// another aspect fills the window's width, as nobody has seen what is beside it, but half of its height is shown at least.
const fit = (degrees, photo = Infinity) => {
  const aspect = innerWidth / innerHeight, shown = Math.max(Math.min(1, photo / aspect), 0.5);
  return Math.atan(Math.tan(degrees * Math.PI / 360) * shown * Math.max(aspect, 1)) * 360 / Math.PI;
};

// The viewer keeps whether its help is open. On a small screen with touch it would cover the model, so it begins closed.
const closeHelp = () => {
  const key = 'controlsPanelOpen';
  try {
    if (matchMedia('(pointer: coarse)').matches && localStorage.getItem(key) === null) localStorage.setItem(key, 'false');
  } catch { /* nothing is kept on this machine */ }
};

// The viewer's cameras are level, and those of the photos were not always. At a bookmark the picture leans as its photo
// does. Away from there it gets level: at a tenth of the way to what the photo shows, or as many radians. The animation
// is level.
const leaning = (viewer, annotations) => {
  const between = (a, b) => Math.hypot(...a.map((value, i) => value - b[i]));
  const bookmarks = annotations.map(({ extras, camera: { initial: { position, target } } }) => {
    const depth = between(target, position);
    return { lean: extras.lean, position, depth, forward: target.map((value, i) => (value - position[i]) / depth) };
  });
  const camera = viewer.app.root.findByName('camera');
  let shown = null;
  return (seconds) => {
    const { x, y, z } = camera.getPosition(), { forward } = camera;
    let wanted = 0, most = 0;
    for (const mark of viewer.state.cameraMode === 'anim' ? [] : bookmarks) {
      const gap = between([x, y, z], mark.position) / mark.depth + between([forward.x, forward.y, forward.z], mark.forward);
      const weight = Math.max(0, 1 - 10 * gap);
      if (weight > most) [most, wanted] = [weight, weight * mark.lean];
    }
    shown = shown === null ? wanted : shown + (wanted - shown) * Math.min(1, 8 * seconds);
    camera.rotateLocal(0, 0, shown);
  };
};

try {
  // Angles are fitted to the size of the window. In a frame this runs before there is a size; a hidden frame has none.
  while (!innerWidth || !innerHeight) await new Promise(requestAnimationFrame);
  const { antialiasing, aspect, name, settings } = JSON.parse(document.getElementById('page').textContent);
  for (const { initial } of settings.cameras) initial.fov = fit(initial.fov, aspect);
  for (const { camera: { initial }, extras } of settings.annotations) initial.fov = fit(initial.fov, extras.aspect);
  for (const { keyframes: { values } } of settings.animTracks) values.fov = values.fov.map((degrees) => fit(degrees));
  closeHelp();
  const code = new Blob([await unpacked('viewer').text()], { type: 'text/javascript' });
  const { createViewer } = await import(URL.createObjectURL(code));
  // The name is given, too, as the viewer cannot take it from an address in a frame whose own is about:srcdoc.
  const viewer = await createViewer({
    container: document.body, settings, contentUrl: name, contentFilename: name,
    contents: Promise.resolve(unpacked('model')), noanim: true,
  });
  viewer.app.scene.gsplat.antiAlias = antialiasing;
  viewer.app.on('update', leaning(viewer, settings.annotations));
  const begin = () => viewer.resetCamera(); // at the first camera; the viewer itself begins in its animation
  viewer.state.loaded ? begin() : viewer.events.once('loaded:changed', begin);
  window.viewer = viewer;
} catch (error) {
  const failure = document.body.appendChild(document.createElement('p'));
  failure.id = 'failure';
  failure.textContent = `The model cannot be shown: ${error.message}. A browser of 2023 or later, with WebGL 2, shows it.`;
  throw error;
}
