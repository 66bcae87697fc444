// Browsers start no worker for a page that is opened from a folder, so a hidden frame runs the script of the search.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.srcdoc = `<script src="${url}"></script>`
      this.started = new Promise(resolve => (frame.onload = resolve)).then(() => {
        frame.contentWindow.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
        return frame.contentWindow
      })
      document.body.append(frame)
    }
    postMessage(data) {
      this.started.then(inner => inner.dispatchEvent(new MessageEvent("message", { data })))
    }
  }
